"""Reloads: the runner watches files, decides what their changes mean, and has dora apply them.

The Reloader outlasts the runs of the dataflow. If a change concerns the dataflow as a whole, the
run ends and the next one begins, in the same unit and the same process.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

from dora_systemd.adapters.dora.preparation import Prepared, resolved
from dora_systemd.adapters.host.watch import Since, identity
from dora_systemd.adapters.runner_socket.client import unknown_request
from dora_systemd.decisions.cell.limits import check_nodes, limits_of
from dora_systemd.decisions.cell.line_rates import rates_of
from dora_systemd.decisions.cell.options import RunnerOptions, SettingText, changed, parse_setting
from dora_systemd.decisions.cell.rights import essential_nodes
from dora_systemd.decisions.descriptor.dataflow import downstream_of
from dora_systemd.decisions.life import events as life
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.names import settings_path
from dora_systemd.runner.cell.failure import words
from dora_systemd.runner.cell.pump import now_us
from dora_systemd.runner.reload.apply import Applier, Run, is_read
from dora_systemd.runner.reload.settings_file import SettingsFile
from dora_systemd.runner.reload.sources import Change, Sources, Versions, Watcher
from dora_systemd.runner.reload.swap import NotReady, patience

PAUSE_SECONDS = 1.0
"""Minimum time between the beginnings of two reloads."""

Answer = dict[str, Any]


class Reloader:
    """Watches files and reloads. options: of the runner. environment: of the nodes.

    given: the options before links in paths were resolved, unless they had none. settings: the
    settings file of the dataflow. current: the version that runs. before: the
    version before a reload of the whole dataflow whose nodes are not all ready yet, or None.
    patience: seconds that the current version may take to be ready. notice: what the last reload
    reports, as long as it is true.
    """

    def __init__(
        self,
        options: RunnerOptions,
        environment: Mapping[str, str],
        settings: SettingsFile,
        given: RunnerOptions | None = None,
    ) -> None:
        self.options = options
        self._given = given or options
        self._settings = settings
        self._environment = environment
        self._sources = Sources(options, environment)
        self._lock = asyncio.Lock()
        self._changed: set[str] = set()
        self._wake = asyncio.Event()
        self._begun = asyncio.Event()
        self._watcher = Watcher(self._take_files, self._refusing, self._has_moved)
        self._run: Run | None = None
        self._outcome: asyncio.Future[str] | None = None
        self._untold: DoraSystemdError | None = None
        self._begun_ns = 0
        self._versions = Versions()
        self._since = Since(time.monotonic_ns(), self._versions.known)
        self._has_imports = False
        self._noting_lock = threading.Lock()
        self._tried: RunnerOptions | None = None
        for path in (options.dataflow, settings.path):
            self._versions.take(path, [path])
        self.current: Prepared | None = None
        self.before: Prepared | None = None
        self.patience = 0
        self.notice = ""

    def begin(self, run: Run, prepared: Prepared, begun_ns: int) -> None:
        """Watch the files of a run. begun_ns: before its nodes start, CLOCK_REALTIME."""
        self._run, self.current, self._begun_ns = run, prepared, begun_ns
        self._has_imports = False
        if not self.options.placed:  # no reload
            for node, files in self._sources.programs(prepared).items():
                self._versions.take(node, files)
        self._begun.set()
        if self._untold is not None:
            self._refuse(self._untold)

    @property
    def run(self) -> Run | None:
        return self._run

    def end(self) -> None:
        """Forget the run, which has ended."""
        self._run = None
        self._begun.clear()

    def has_started(self) -> None:
        """Forget the former version, because all nodes of the run are ready."""
        self.before = None
        self._settle("")
        if self.options.hot_reload and not self.options.placed:
            # Only now: a start should not wait until all sources of a large project are parsed.
            self._noting = asyncio.create_task(asyncio.to_thread(self._note_imports))

    def _note_imports(self) -> None:
        """Record the versions of imported modules, once in each run. Blocks.

        It parses all that nodes import: 1.5 s of CPU time for numpy. Without hot reload it waits
        for the first reload, because what was written since the start stays unknown in any case.
        """
        with self._noting_lock, contextlib.suppress(DoraSystemdError):  # a program has gone
            current = self.current
            if current is not None and not self._has_imports:
                self._has_imports = True
                for node, files in self._sources.files(current).items():
                    self._versions.add(node, files, self._begun_ns)

    def go_back(self, reason: str) -> bool:
        """Switch back if a run failed during its start; return whether a former version exists."""
        self._settle(reason)
        if self.before is None:
            return False
        self.current, self.before = self.before, None
        self._follow(self.current.plan.options)
        self.notice = f"not reloaded: {reason}"
        return True

    def definition(self, node: str) -> Mapping[str, Any]:
        """Return the definition of a node of the current version, as dora gets it."""
        nodes = self.current.descriptor["nodes"] if self.current else []
        return next(one for one in nodes if one["id"] == node)

    def has_readers(self, node: str) -> bool:
        """Whether anything has an input from this node of the current version."""
        versions = [self.current] if self.current else []
        return is_read(node, self.options, *versions)

    def _settle(self, outcome: str) -> None:
        if self._outcome is not None and not self._outcome.done():
            self._outcome.set_result(outcome)

    async def work(self) -> None:
        """Reload changed files until cancelled."""
        try:
            self._settings.keep()
        except DoraSystemdError as error:
            self._refuse(error)  # of this file only: the others can be reloaded
        # Not only what is saved from now on: this can be late, and no start should wait for it.
        self._watcher.watch(self.options if self.options.hot_reload else None, self._since)
        while True:
            await self._wake.wait()
            await self._begun.wait()
            pause = asyncio.create_task(asyncio.sleep(PAUSE_SECONDS))
            with self._refusing("cannot reload"):
                await self._reload_saved()
            await pause

    async def _reload_saved(self) -> None:
        async with self._lock:
            if self._wake.is_set():  # else hot reload was switched off in the meantime
                self._wake.clear()
                changed, self._changed = self._changed, set()
                await self._reload(changed)

    @contextlib.contextmanager
    def _refusing(self, what: str) -> Iterator[None]:
        """Report any exception: the dataflow keeps running, and the next change can succeed."""
        try:
            yield
        except DoraSystemdError as error:
            self._refuse(error)
        except Exception as error:
            self._refuse(DoraSystemdError(f"{what}: {words(error)}", "please report it"))

    def _take_files(self, files: frozenset[str]) -> None:
        self._changed |= files
        self._wake.set()

    def _refuse(self, error: DoraSystemdError) -> None:
        """Report that the old version keeps running, in the notice as soon as there is a run."""
        self._untold = error if self._run is None else None
        self.notice = f"not reloaded: {error.message.removeprefix('cannot use ')}"
        if self._run is not None:
            needed = essential_nodes(self.options)
            self._run.pump.push(life.ReloadNoted(now_us(), self.notice, essential=needed))
            hint = f" ({error.hint})" if error.hint else ""
            self._run.pipes.write_event("reload-failed", reason=error.message + hint)

    async def _reload(self, changed: Collection[str], node: str = "") -> list[str]:
        """Apply the changed files, and reload `node` in any case; return what was done.

        The caller holds the lock.
        """
        run, current = self._run, self.current
        if run is None or current is None:
            hint = "wait until it has started"
            raise DoraSystemdError("cannot reload: no node runs", hint, ExitCode.NOT_RUNNING)
        moved = await asyncio.to_thread(self._moved)
        if moved is not None:
            return await self._follow_link(run, moved)
        taken = Versions()
        for path in {self.options.dataflow, self._settings.path}.intersection(changed):
            taken.take(path, [path])
        done = await self._take_settings(run) if self._settings.path in changed else []
        changed = [path for path in changed if path != self._settings.path]
        try:
            look = self._sources.look
            change = await asyncio.to_thread(look, current, changed, self._versions)
        except DoraSystemdError:
            self._changed |= set(changed)  # the next change may be what was missing
            raise
        change = change.with_node(node, self.options.dataflow) if node else change
        if change.steps or change.whole:
            run.pipes.write_event("files-changed", files=", ".join(change.names(changed)))
            done += await self._apply(run, change)
        self._versions.merge(taken)
        self.notice = ""
        if self._run is not None and (done or self._run.pump.cell.notice):
            fed = downstream_of(change.prepared.dataflow)
            self._run.pump.push(life.ReloadNoted(now_us(), "", fed))
        return done

    def _has_moved(self) -> bool:
        """Whether links lead to a dataflow that has not been tried."""
        return self._moved() not in (None, self._tried)

    def _moved(self) -> RunnerOptions | None:
        """Return the options with the present paths, if links have changed. Blocks."""
        now = resolved(self._given)
        is_there = self.options.placed or _place(now) == _place(self.options)
        return None if is_there else _at(self.options, now)

    async def _follow_link(self, run: Run, moved: RunnerOptions) -> list[str]:
        """Run the whole dataflow that a link leads to now, as its daemon knows directories."""
        self._tried, since = moved, Since(time.monotonic_ns())
        taken = Versions()
        taken.take(moved.dataflow, [moved.dataflow])
        change = await asyncio.to_thread(Sources(moved, self._environment).look_elsewhere)
        run.pipes.write_event("files-changed", files=moved.dataflow)
        self._follow(moved, since)
        done = await self._apply(run, change)
        self._versions.merge(taken)
        return done

    def _follow(self, moved: RunnerOptions, since: Since | None = None) -> None:
        """Use the paths of these options from now on. since: as of Watcher.watch()."""
        if _place(moved) != _place(self.options):
            self.options = _at(self.options, moved)
            self._sources = Sources(self.options, self._environment)
            self._settings.path = settings_path(moved.dataflow)
            self._watcher.watch(self.options if self.options.hot_reload else None, since)

    async def _take_settings(self, run: Run) -> list[str]:
        """Apply changed node limits at once; other settings wait for the next start."""
        texts, others = await asyncio.to_thread(self._settings.change)
        limits = limits_of(self.options._replace(settings=texts))
        check_nodes(limits, run.pump.cell.nodes, ())
        run.nodes.limit(limits)
        self._settings.accept()
        self._change(texts)
        name = PurePath(self._settings.path).name
        for one in limits:
            run.pipes.write_event("node-reloaded", one.node, how="given new limits", reason=name)
        if others:
            keys = ", ".join(others)
            reason = f"{name}: {keys}: only doractl stop and start apply this"
            run.pipes.write_event("reload-failed", reason=reason)
        return [f"the node {one.node} was given new limits: {name}" for one in limits]

    async def _apply(self, run: Run, change: Change) -> list[str]:
        applier = Applier(run, change, self.options, self._versions)
        reason = change.whole or applier.obstacle()
        if not reason:
            try:
                async with run.lock:
                    await applier.apply()
                self.current = change.prepared
                return applier.done
            except NotReady as error:
                raise await self._undo(applier, change, error) from error
            except DoraSystemdError as error:
                reason = error.message
        return await self._restart(run, change, reason)

    async def _undo(self, applier: Applier, change: Change, error: NotReady) -> DoraSystemdError:
        """Restore the old descriptor; an old version of a program file no longer exists.

        dora does not restart a node without restarts left: then the next run has the old version.
        """
        if change.prepared is self.current:
            return DoraSystemdError(f"cannot use what was saved: {error}")
        assert self.current is not None
        try:
            await applier.undo(self.current)
        except DoraSystemdError as refused:
            back = change._replace(prepared=self.current)
            await self._restart(applier.run, back, refused.message)
        again = "the previous version is running again"
        return DoraSystemdError(f"cannot use {self.options.dataflow}: {error}; {again}")

    async def _restart(self, run: Run, change: Change, reason: str) -> list[str]:
        begun = time.monotonic()
        self.before = self.current if change.prepared is not self.current else None
        self.current, self.patience = change.prepared, patience(run.pump.cell)
        self._outcome = asyncio.get_running_loop().create_future()
        run.pump.push(life.ReloadAsked(now_us()))
        if failure := await self._outcome:
            raise DoraSystemdError(f"cannot use {change.prepared.dataflow.source}: {failure}")
        took = f"{time.monotonic() - begun:.2f}s"
        text = f"{reason}; ready after {took}"
        run.pipes.write_event("reloaded", reason=text, file=", ".join(change.program_files()))
        return [f"the dataflow was reloaded: {text}"]

    async def answer(self, request: Mapping[str, Any]) -> Answer:
        """Answer a request of doractl.

        {"verb": "reload"}, {"verb": "hot-reload", "on": true}, or {"verb": "log-rates"} with all
        limits. Raises DoraSystemdError.
        """
        if request.get("verb") == "log-rates":
            texts = map(str, request.get("limits") or ())
            return await self._limit_lines([*map(parse_setting, texts)])
        if request.get("verb") == "hot-reload":
            return await self._switch(bool(request.get("on")))
        if request.get("verb") != "reload":
            raise unknown_request(request)
        node = str(request.get("node") or "")
        changed = [] if node else await asyncio.to_thread(self._changed_since)
        try:
            async with self._lock:
                return {"done": await self._reload(changed, node)}
        except DoraSystemdError as error:
            self._refuse(error)
            raise

    def _changed_since(self) -> list[str]:
        """Return the files that differ from the running ones. Blocks. Raises DoraSystemdError."""
        current, dataflow = self.current, self.options.dataflow
        if current is None or self._moved() is not None:
            return []
        if identity(dataflow) is None:
            message = f"cannot read {dataflow}: there is no such file"
            raise bad_input(message, "put it back, or stop the dataflow")
        self._note_imports()
        versions = self._versions
        stale = {path for path in (dataflow, self._settings.path) if versions.differ(path)}
        for node, files in self._sources.files(current).items():
            stale |= versions.stale(node, files)
        return sorted(stale)

    async def _switch(self, is_on: bool) -> Answer:
        async with self._lock:
            self.options = self.options.with_value("hot_reload", is_on)
            self._sources = Sources(self.options, self._environment)
            # This changes only how dora treats nodes that fail: each gets it with its next reload.
            if self.current is not None:
                self.current = self._sources.replan(self.current)
            self._watcher.watch(self.options if is_on else None)
            if is_on:
                await asyncio.to_thread(self._note_imports)
            else:  # a save that waits for its turn is reloaded neither, as the answer promises
                self._wake.clear()
                self._changed.clear()
            # What is saved after the answer counts.
            await self._watcher.wait_seeing()
        return {"done": []}

    def _change(self, texts: Iterable[SettingText]) -> None:
        self.options = self.options._replace(settings=changed(self.options.settings, texts))

    async def _limit_lines(self, limits: Sequence[SettingText]) -> Answer:
        options = self.options.without("log_rate_limit")
        options = options._replace(settings=(*options.settings, *limits))
        rates = rates_of(options)  # refuses what is no limit
        async with self._lock:
            self.options = options
            if self._run is not None:
                self._run.nodes.limit_lines(rates)
        return {"done": []}

    def close(self) -> None:
        self._watcher.watch(None)


def _place(options: RunnerOptions) -> tuple[str, str]:
    return options.dataflow, options.working_directory


def _at(options: RunnerOptions, place: RunnerOptions) -> RunnerOptions:
    dataflow, directory = _place(place)
    return options._replace(dataflow=dataflow, working_directory=directory)

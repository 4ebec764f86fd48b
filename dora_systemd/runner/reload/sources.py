"""Reads and watches the files of a dataflow, and finds what has changed and what that means."""

import asyncio
import json
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path, PurePath
from typing import NamedTuple

from dora_systemd.adapters.dora.check import refusal_of_dora
from dora_systemd.adapters.dora.preparation import Prepared, prepare
from dora_systemd.adapters.host.watch import Identity, Since, changed_files, identity, watch_rules
from dora_systemd.decisions.cell.launch import kinds, launch_descriptor, sources
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.nodes import NodeKind
from dora_systemd.decisions.reload.changes import (
    Difference,
    How,
    NodeSources,
    Step,
    difference,
    plan_steps,
    touched,
)
from dora_systemd.decisions.reload.imports import program_files, syntax_error
from dora_systemd.decisions.reload.watch_rules import WatchRules
from dora_systemd.errors import bad_input
from dora_systemd.runner.cell.begin import let_openssl_in

_LONGEST_SECONDS = 10.0
"""Maximum time that the client waits for the watches of a large tree, to turn on hot reload."""


class Versions:
    """The identities of the files that each node runs.

    A file of the dataflow itself, such as the settings file, has an entry with its path as node.
    """

    def __init__(self) -> None:
        self._known: dict[str, dict[str, Identity | None]] = {}

    def take(self, node: str, paths: Iterable[str]) -> None:
        """Record that `node` runs the present versions of `paths`, and no other files."""
        self._known[node] = _identities(paths)

    def merge(self, taken: "Versions") -> None:
        """Take over the versions that were recorded in `taken`, once the nodes run them."""
        self._known |= taken._known

    def add(self, node: str, paths: Iterable[str], begun_ns: int) -> None:
        """Record the present versions of those `paths` that are not known yet.

        A file that was written since `begun_ns` stays unknown: the node may run an older version. A
        file with a later time than now was written before the clock was set back.
        """
        known = self._known.setdefault(node, {})
        present = _identities(set(paths) - known.keys())
        now_ns = time.time_ns()  # not earlier: a file can be saved while others are looked up
        for path, one in present.items():
            if one is None or not begun_ns < one.changed_ns <= now_ns:
                known[path] = one

    def known(self) -> Iterator[tuple[str, Identity | None]]:
        """The known versions of all files. May be called in any thread."""
        for files in list(self._known.values()):
            yield from list(files.items())

    def differ(self, path: str) -> bool:
        """Return whether a file of the dataflow itself was changed, created or removed."""
        return self._known.get(path, {}).get(path) != identity(path)

    def stale(self, node: str, paths: Iterable[str]) -> set[str]:
        """Return those `paths` that exist in another version than `node` runs."""
        known = self._known.get(node, {})
        now = _identities(paths)
        return {path for path, one in now.items() if one is not None and known.get(path) != one}


def _identities(paths: Iterable[str]) -> dict[str, Identity | None]:
    return {path: identity(path) for path in paths}


class Change(NamedTuple):
    """The meaning of changed files for the running dataflow."""

    prepared: Prepared
    steps: tuple[Step, ...] = ()
    whole: str = ""  # why the whole dataflow has to start again, or ""
    operators: Mapping[str, Mapping[str, str]] = {}
    files: Mapping[str, frozenset[str]] = {}  # of the programs, by node

    def program_files(self) -> list[str]:
        """The files of the steps, each once."""
        return list(dict.fromkeys(step.file for step in self.steps))

    def names(self, changed: Collection[str]) -> list[str]:
        """The names of the files that matter; of all `changed` files for a whole reload."""
        found = self.program_files() if self.steps else sorted(changed)
        return [PurePath(path).name for path in found]

    def with_node(self, node: str, dataflow: str) -> "Change":
        """The change, with a reload of `node` added if it is missing. Raises DoraSystemdError."""
        if any(step.node == node for step in self.steps):
            return self
        if self.prepared.dataflow.node(node) is None:
            message = f"cannot reload the node {node}: it is not in {dataflow}"
            raise bad_input(message, "add it to that file")
        operators = self.operators.get(node, {})
        steps = [Step(How.OPERATOR, node, file) for name, file in operators.items() if name]
        if not steps:
            steps = [Step(How.SWAP, node, operators.get("", dataflow))]
        return self._replace(steps=(*self.steps, *steps))


class Sources:
    """Reads files for a runner with these options. environment: that of the nodes."""

    def __init__(self, options: RunnerOptions, environment: Mapping[str, str]) -> None:
        self._options = options
        self._environment = environment

    def look(self, current: Prepared, changed: Collection[str], versions: Versions) -> Change:
        """Decide what the files `changed` mean for the running version `current`.

        versions: of the files that the nodes run. Blocks: do not call it in the loop's thread.
        Raises DoraSystemdError if a file is not valid; then nothing should be changed.
        """
        # A deleted file cannot be loaded. It may be back in a moment, as with git checkout.
        paths = frozenset(path for path in changed if identity(path))
        if changed and not paths:
            return Change(current)
        dataflow = self._options.dataflow
        prepared = self.prepare() if dataflow in paths else current
        programs = sources(prepared.dataflow, prepared.plan)
        nodes = self._nodes(prepared, programs, versions)
        found = touched(paths, dataflow, nodes)
        check_programs(found.nodes.values())
        difference_ = (
            difference(current.descriptor, prepared.descriptor)
            if found.descriptor
            else Difference()
        )
        how = kinds(prepared.dataflow, prepared.plan)
        steps = plan_steps(found, difference_, how, dataflow)
        whole = difference_.whole or _stubborn(steps, programs)
        files = {node: one.files for node, one in nodes.items()}
        return Change(prepared, steps, whole, programs, files)

    def look_elsewhere(self) -> Change:
        """The change to the dataflow of these options from another one. Raises DoraSystemdError."""
        prepared = self.prepare()
        for files in self.files(prepared).values():
            check_programs(files)
        directory = PurePath(self._options.dataflow).parent
        return Change(prepared, whole=f"its path leads to {directory} now")

    def prepare(self) -> Prepared:
        """Read the dataflow again, as at a start. Raises DoraSystemdError."""
        options = self._options
        prepared = prepare(options, self._environment, is_reload=True)
        if reason := refusal_of_dora(options, self._environment):
            raise bad_input(f"cannot use {options.dataflow}: {reason}")
        return prepared

    def replan(self, current: Prepared) -> Prepared:
        """`current` with these options. Reads no file: it may be in the middle of an edit."""
        plan = current.plan._replace(options=self._options)
        descriptor = launch_descriptor(current.dataflow, plan)
        return Prepared(current.dataflow, plan, descriptor)

    def programs(self, current: Prepared) -> dict[str, list[str]]:
        """The files that each node is started from. Raises DoraSystemdError."""
        programs = sources(current.dataflow, current.plan)
        return {node: list(files.values()) for node, files in programs.items()}

    def files(self, current: Prepared) -> dict[str, frozenset[str]]:
        """The files of the programs, by node, as absolute paths. Raises DoraSystemdError."""
        programs = sources(current.dataflow, current.plan)
        return {
            node.id: self._files(programs[node.id].values(), node.kind)
            for node in current.dataflow.nodes
        }

    def _nodes(
        self, prepared: Prepared, programs: Mapping[str, Mapping[str, str]], versions: Versions
    ) -> dict[str, NodeSources]:
        own, root = self._options.by_node("watch"), self._options.working_directory
        found = {}
        for node in prepared.dataflow.nodes:
            patterns = own.get(node.id, ())
            files = self._files(programs[node.id].values(), node.kind)
            found[node.id] = NodeSources(
                files,
                json.dumps(node.raw, default=str),
                WatchRules(root, patterns) if patterns else None,
                files - versions.stale(node.id, files),
            )
        return found

    def _files(self, scripts: Iterable[str], kind: NodeKind) -> frozenset[str]:
        if kind not in (NodeKind.PYTHON, NodeKind.OPERATOR):
            return frozenset(scripts)
        root = self._options.working_directory
        path = self._environment.get("PYTHONPATH", "")
        places = [*filter(None, path.split(":")), root, f"{root}/src"]
        every = (program_files(one, _read, places) for one in scripts)
        return frozenset().union(*every)


def _stubborn(steps: Iterable[Step], operators: Mapping[str, Mapping[str, str]]) -> str:
    """Return why dora cannot apply a change of an operator, or "": it reloads only its file."""
    for step in steps:
        if step.how is How.OPERATOR and step.file not in operators[step.node].values():
            return f"the operators of the node {step.node} import {Path(step.file).name}"
    return ""


def check_programs(paths: Iterable[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a program that is unreadable or does not compile."""
    for path in paths:
        is_python = path.endswith(".py")
        try:
            with Path(path).open(errors="replace") as file:
                text = file.read() if is_python else ""  # a binary may have a gigabyte
        except IsADirectoryError:
            continue  # a link that a pattern matches, to a directory
        except OSError as error:
            raise bad_input(f"cannot use {path}: {error.strerror}") from error
        if is_python and (reason := syntax_error(path, text)):
            raise bad_input(f"cannot use {path}: {reason}")


def _read(path: str) -> str | None:
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return None


class Watcher:
    """Reports changed files.

    found: takes the files that have changed. refusing: reports an exception inside. has_moved:
    whether links lead to another dataflow.
    """

    def __init__(
        self,
        found: Callable[[frozenset[str]], None],
        refusing: Callable[[str], AbstractContextManager[None]],
        has_moved: Callable[[], bool] = bool,
    ) -> None:
        self._found = found
        self._has_moved = has_moved
        self._refusing = refusing
        self._task: asyncio.Task[None] | None = None
        self._has_seen = asyncio.Event()

    def watch(self, options: RunnerOptions | None, since: Since | None = None) -> None:
        """Watch the files of these options; None: watch nothing.

        since: report what was saved after that; by default, after this call.
        """
        since = since or Since(time.monotonic_ns())
        if self._task is not None:
            self._task.cancel()
        self._has_seen.clear()
        self._task = None if options is None else asyncio.create_task(self.collect(options, since))

    async def wait_seeing(self) -> None:
        """Return once a file that changes is noticed, or watching has failed."""
        if self._task is None:
            return
        seen = asyncio.create_task(self._has_seen.wait())
        first = asyncio.FIRST_COMPLETED
        await asyncio.wait({self._task, seen}, timeout=_LONGEST_SECONDS, return_when=first)
        seen.cancel()

    async def collect(self, options: RunnerOptions, since: Since | None = None) -> None:
        """Pass each burst of changed files to found(). Returns only if watching fails."""
        with self._refusing("cannot watch files any more"):
            rules = await asyncio.to_thread(watch_rules, options)
            let_openssl_in()  # watchfiles imports anyio, which imports ssl
            seen, has_moved = self._has_seen.set, self._has_moved
            async for files in changed_files(rules, seen, has_moved, since=since):
                self._found(files)

"""Builds a release: `uv sync` and `dora build`, as the user of the nodes and in their sandbox.

The project is copied into a tree that this user may change, and built there. Then the tree is read
as the project was, by a process of that user, and what arrives is checked again: root believes
nothing of a build. No hard link leads from the tree to another release.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePath
from signal import SIGKILL

from dora_systemd.adapters.bus.manager import DOWN, Manager, Property, is_at_rest
from dora_systemd.adapters.releases.draft import BuildTree
from dora_systemd.adapters.releases.store import Store, remove_tree
from dora_systemd.decisions.cell.options import build_command
from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.logs.events import BUILD_FAILED
from dora_systemd.decisions.releases.build import (
    BuildTask,
    build_environment,
    build_unit,
    format_task,
)
from dora_systemd.decisions.releases.entries import Found
from dora_systemd.decisions.releases.progress import copying
from dora_systemd.decisions.unit.build import build_properties
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.project import Project, opened_project
from dora_systemd.values import INFINITY, SECOND, format_duration
from dora_systemd.verbs.facts.reason import failure_reason, runners_refusal
from dora_systemd.verbs.releases.built_files import find_built
from dora_systemd.verbs.releases.files import copy_files
from dora_systemd.verbs.releases.soak import Tell
from dora_systemd.verbs.releases.source import Source
from dora_systemd.verbs.releases.trial import Standing, remains
from dora_systemd.verbs.start.account import account_of
from dora_systemd.verbs.start.asked import note_request
from dora_systemd.verbs.start.check import beside_properties, exec_start

_LIBEXEC = str(Path(__file__).parents[2] / "libexec/builds")
_LOOK_SECONDS = 0.2
_GONE_SECONDS = 20.0
_LATE_SECONDS = 30.0
"""After which systemd's own bound does not hold: the main process may ask for more."""


@dataclass(frozen=True)
class Build:
    """A build of a release of `source`.

    release, uuid: ids of the release and the dataflow. timeout: µs. on_line: gets the last line
    of what the build has printed, "" before the first, each time that somebody looks.
    """

    scope: Scope
    source: Source
    store: Store
    release: str
    uuid: str
    commands: Sequence[Sequence[str]]
    timeout: int
    on_line: Callable[[str], None]

    @property
    def unit(self) -> str:
        """The unit that it runs in."""
        return build_unit(self.store.name)

    def sent(self, manager: Manager, tree: BuildTree, reading: int) -> list[Property]:
        """The properties of the unit. reading: its standard input."""
        return _sent(manager, self, tree, reading)

    @property
    def place(self) -> Path:
        """Where its files will be, and where the build sees them already."""
        return self.store.tree(self.release)


@contextmanager
def built_project(
    manager: Manager, build: Build, project: Project, found: Mapping[str, Found], tell: Tell
) -> Iterator[tuple[Project, dict[str, Found]]]:
    """The project after its build, and the files that belong to its release.

    found: those of the project. Raises DoraSystemdError (BAD_INPUT) for a build that fails or does
    not end, or leaves what no release can have, and OSError.
    """
    user = build.source.plan.user
    tree = BuildTree(build.store)
    try:
        tree.require_space(sum(one.size for one in found.values()))
        files = copy_files(project, found, tree, None, lambda *amount: tell(copying(*amount)))
        tree.hand_over(files, None if user is None else (user.pw_uid, user.pw_gid))
        with _noted(build):
            _run(manager, build, tree)
        root, place = build.source.root, str(tree.tree)
        with opened_project(root, account_of(user), place) as built:
            with _noted(build):
                left = find_built(built, build.source.named, build.place, build.scope.is_user)
            yield built, left
    finally:
        tree.discard()


@contextmanager
def _noted(build: Build) -> Iterator[None]:
    """Write an event if the build fails."""
    try:
        yield
    except DoraSystemdError as error:
        reason = error.message.removeprefix(f"cannot build {build.store.name}: ")
        details = {"scope": build.scope.word, "release": build.release, "reason": reason}
        note_request(BUILD_FAILED, build.store.name, build.uuid, "doractl deploy", **details)
        raise


def _run(manager: Manager, build: Build, tree: BuildTree) -> None:
    """Run the unit of the build to its end, which is also that of all its processes."""
    end_former(manager, build.unit)
    reading, writing = os.pipe2(os.O_CLOEXEC)
    try:
        with _stopped(manager, build.unit):
            _start(manager, build, tree, reading)
            _wait(manager, build, tree)
        _check_end(manager, build)
    finally:
        os.close(writing)  # our end is its end


def _start(manager: Manager, build: Build, tree: BuildTree, reading: int) -> None:
    try:
        sent = build.sent(manager, tree, reading)
        manager.start_transient(build.unit, sent, None, wait=False)
    finally:
        os.close(reading)


@contextmanager
def _stopped(manager: Manager, unit: str) -> Iterator[None]:
    """Stop a unit after an exception, also if systemd may or may not have got its start."""
    try:
        yield
    except BaseException:
        # Whatever its state is: a start that is queued is replaced by that.
        with suppress(DoraSystemdError):  # the first error is the one to tell
            manager.run_jobs("StopUnit", [unit])
        raise


def end_former(manager: Manager, unit: str) -> None:
    """Stop the build of a deploy that was killed: it notices that itself, unless it is hostile."""
    deadline = time.monotonic() + _GONE_SECONDS
    while time.monotonic() < deadline:
        # A unit that systemd has been asked about is listed for a while, but not loaded.
        known = [one for one in manager.list_units(unit) if one.load == "loaded"]
        if not known:
            return
        if known[0].active not in DOWN:
            manager.run_jobs("StopUnit", [unit])
        with suppress(DoraSystemdError):  # systemd has unloaded it meanwhile
            manager.reset_failed(unit)
        time.sleep(_LOOK_SECONDS)


def _wait(manager: Manager, build: Build, tree: BuildTree) -> None:
    """Wait for the end of the unit. Raises DoraSystemdError if it fills the disk, or has no end."""
    told, deadline = "", time.monotonic() + build.timeout / SECOND + _LATE_SECONDS
    while True:
        facts = manager.read(build.unit, ["ActiveState", "Job", "StatusText"])
        if is_at_rest(facts):
            return
        line = str(facts["StatusText"])
        if line not in ("", told) and not line.startswith(FAILED_BECAUSE):  # an error tells that
            told = line
        build.on_line(told)
        if build.timeout != INFINITY and time.monotonic() > deadline:
            raise _late(build, _hint(build))
        if tree.is_disk_full():
            reason = "it has left too little space on the disk"
            raise _refusal(build, reason, f"see df {build.store.path}", ExitCode.FAILURE)
        time.sleep(_LOOK_SECONDS)


def _check_end(manager: Manager, build: Build) -> None:
    """Raise DoraSystemdError (BAD_INPUT) unless the build has succeeded."""
    hint = _hint(build)
    result = str(manager.read(build.unit, ["Result"])["Result"])
    if refusal := runners_refusal(manager, build.unit):
        raise DoraSystemdError(refusal.message, hint, ExitCode.BAD_INPUT)
    if result == "timeout":
        raise _late(build, hint)
    if result != "success":
        raise _refusal(build, failure_reason(manager, build.unit), hint)


def _late(build: Build, hint: str) -> DoraSystemdError:
    most = format_duration(build.timeout)
    hint = f"{hint}; --build-timeout allows more time"
    return _refusal(build, f"it did not end within {most}", hint)


def _hint(build: Build) -> str:
    own = "--user " if build.scope.is_user else ""
    return f"journalctl {own}--unit {build.unit} has all that it printed"


def _refusal(
    build: Build, reason: str, hint: str, code: ExitCode = ExitCode.BAD_INPUT
) -> DoraSystemdError:
    return DoraSystemdError(f"cannot build {build.store.name}: {reason}", hint, code)


def _sent(manager: Manager, build: Build, tree: BuildTree, reading: int) -> list[Property]:
    plan, place = build.source.plan, build.place
    directory = str(PurePath(place, build.source.dataflow).parent)
    commands = tuple(tuple(one) for one in build.commands)
    task = BuildTask(plan.options.name, build.uuid, build.release, directory, commands)
    own = build.source.own_venv
    venv = None if own is None else str(place / own)
    more = _LIBEXEC if build.source.uv else ""
    properties = build_properties(
        beside_properties(manager, plan),
        str(tree.tree),
        str(place),
        str(build.store.path.parent),
        build_environment(plan.environment, venv, plan.options.venv, more),
        build.timeout,
        build.scope.is_user,
    )
    return [
        *properties.values(),
        ("Description", "s", f"build of release {build.release} of dora dataflow {task.name}"),
        exec_start(build_command(sys.executable, format_task(task))),
        ("StandardInputFileDescriptor", "h", reading),
        # What a build leaves may ignore another signal, and the unit would fail by that.
        ("KillSignal", "i", int(SIGKILL)),
        ("CollectMode", "s", "inactive-or-failed"),
        ("AddRef", "b", True),
    ]


def clean(manager: Manager, store: Store, standing: Standing) -> None:
    """Remove what a deploy or rollback that was killed has left, and end a build that still runs.

    The caller holds the lock of the store. Raises DoraSystemdError.
    """
    if store.unfinished():
        end_former(manager, build_unit(store.name))
    for path in remains(store, standing):
        remove_tree(path)

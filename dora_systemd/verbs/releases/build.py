"""Builds a release: `uv sync` and `dora build`, as the user of the nodes and in their sandbox.

The project is copied into a tree that this user may change, and built there. Then the tree is read
as the project was, by a process of that user, and what arrives is checked again: root believes
nothing of a build. No hard link leads from the tree to another release.
"""

import os
import posixpath
import stat
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from signal import SIGKILL

from dora_systemd.adapters.bus.manager import DOWN, Manager, Property, is_at_rest
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.adapters.releases.draft import BuildTree
from dora_systemd.adapters.releases.store import Store, remove_tree
from dora_systemd.decisions.cell.options import build_command
from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.logs.journal_events import BUILD_FAILED
from dora_systemd.decisions.releases.build import (
    BuildTask,
    build_environment,
    build_properties,
    build_unit,
    format_task,
)
from dora_systemd.decisions.releases.manifest import (
    DIRECTORY,
    FILE,
    LINK,
    MOST_FILES,
    Found,
    check_amount,
    check_found,
    is_plain_path,
    refusal,
    too_many,
)
from dora_systemd.decisions.releases.progress import copying
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import reached
from dora_systemd.trust.project import Project, opened_project
from dora_systemd.values import INFINITY, SECOND, format_duration
from dora_systemd.verbs.facts.reason import failure_reason, runners_refusal
from dora_systemd.verbs.releases.files import copy_files
from dora_systemd.verbs.releases.soak import Tell
from dora_systemd.verbs.releases.source import Source
from dora_systemd.verbs.releases.trial import Standing, remains
from dora_systemd.verbs.start.check import beside_properties, exec_start
from dora_systemd.verbs.start.where import account_of

_LIBEXEC = str(Path(__file__).parents[2] / "libexec/builds")
_LOOK_SECONDS = 0.2
_GONE_SECONDS = 20.0
_LATE_SECONDS = 30.0
"""Time after systemd's own timeout, which the main process may extend."""
_VENV, _CACHE = "pyvenv.cfg", "CACHEDIR.TAG"
"""Files whose directory is a virtual environment, or a cache such as Cargo's `target`."""
_HINT = "the build has left it: have the build remove it, or make something else of it"
_PYTHON_HINT = (
    "create the virtual environment with a Python of the system, such as /usr/bin/python3"
)
_LEFT_OUT = (".git", "__pycache__")
_LEFT_OUT_OF_CACHE = (*_LEFT_OUT, "build", "deps", "examples", "incremental", ".fingerprint")


@dataclass(frozen=True)
class Build:
    """A build of a release of `source`."""

    scope: Scope
    source: Source
    store: Store
    # release, uuid: ids of the release and the dataflow
    release: str
    uuid: str
    commands: Sequence[Sequence[str]]
    timeout: int  # µs
    # gets the last line of the build's output, "" before the first, at each check of the unit
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
        """The final path of the release; the build runs with its files mounted there."""
        return self.store.tree(self.release)


@contextmanager
def built_project(
    manager: Manager, build: Build, project: Project, found: Mapping[str, Found], tell: Tell
) -> Iterator[tuple[Project, dict[str, Found]]]:
    """Build the project; yield it, and the files of its release.

    found: files of the project. Raises DoraSystemdError (BAD_INPUT) for a build that fails, does
    not end, or leaves a file that no release can have, and OSError.
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
        with stopped_after_error(manager, build.unit):
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
def stopped_after_error(manager: Manager, unit: str) -> Iterator[None]:
    """Stop a unit after an exception, whether or not systemd has received its start."""
    try:
        yield
    except BaseException:
        # In any state of the unit: the stop replaces a queued start.
        with suppress(DoraSystemdError):  # the first error is the one to report
            manager.run_jobs("StopUnit", [unit])
        raise


def end_former(manager: Manager, unit: str) -> None:
    """Stop the build of a killed deploy, which notices the kill itself unless it is hostile."""
    deadline = time.monotonic() + _GONE_SECONDS
    while time.monotonic() < deadline:
        # After a request for an unknown unit, systemd lists that unit for a while as not loaded.
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
        # A line with FAILED_BECAUSE becomes an error at the end.
        if line not in ("", told) and not line.startswith(FAILED_BECAUSE):
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
        raise bad_input(refusal.message, hint)
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


def find_built(
    project: Project, named: Sequence[str], tree: Path, is_user: bool
) -> dict[str, Found]:
    """The files of a built release by path.

    named: paths that belong to it although they are in a cache, such as Cargo's target. tree: where
    the files will be. Raises DoraSystemdError (BAD_INPUT) for what a release cannot have.
    """
    try:
        return _checked(project, named, tree, is_user)
    except DoraSystemdError as error:
        if error.code is not ExitCode.BAD_INPUT or error.hint == _PYTHON_HINT:
            raise
        # Not the hint for a file of the project.
        raise DoraSystemdError(error.message, _HINT, error.code) from error


def _checked(project: Project, named: Sequence[str], tree: Path, is_user: bool) -> dict[str, Found]:
    found, venvs = _walk(project)
    for row in project.facts(named) if named else ():
        if row is not None and row[1] != DIRECTORY and not _is_behind_link(row[0], found):
            found[row[0]] = Found(*row)
    if len(found) > MOST_FILES:
        raise too_many("")
    for one in found.values():
        if not _is_interpreter(one, venvs, is_user):
            check_found(_relative(one, tree))
    check_amount(found.values())
    return dict(sorted(found.items()))


def _walk(project: Project) -> tuple[dict[str, Found], set[str]]:
    """Find all files, and the directories that are virtual environments."""
    found: dict[str, Found] = {}
    venvs: set[str] = set()
    queue = [("", "")]
    for directory, above in queue:
        entries = [Found(*row) for row in project.listed(directory, MOST_FILES + 1)]
        names = {posixpath.basename(one.path) for one in entries if one.kind == FILE}
        what = above or next((mark for mark in (_VENV, _CACHE) if mark in names), "")
        venvs |= {directory} if _VENV in names else set()
        for one in entries:
            if not _is_left_out(one, what):
                queue += [(one.path, what)] if one.kind == DIRECTORY else []
                found |= {one.path: one} if one.kind != DIRECTORY else {}
        if len(found) + len(queue) > MOST_FILES:
            raise too_many(directory)
    return found, venvs


def _is_left_out(one: Found, what: str) -> bool:
    """Whether no release needs it. what: _VENV or _CACHE if it is in such a directory."""
    if what == _CACHE and one.kind == FILE:
        return not one.is_executable
    names = {_VENV: (), _CACHE: _LEFT_OUT_OF_CACHE}.get(what, _LEFT_OUT)
    return one.kind == DIRECTORY and posixpath.basename(one.path) in names


def _is_behind_link(path: str, found: Mapping[str, Found]) -> bool:
    """Whether a link that the release has leads to it."""
    parts = path.split("/")
    return any("/".join(parts[:count]) in found for count in range(1, len(parts)))


def _relative(one: Found, tree: Path) -> Found:
    """The file, with an absolute target in the tree as a relative one."""
    if one.kind != LINK or not f"{one.target}/".startswith(f"{tree}/"):
        return one
    inside = one.target.removeprefix(str(tree)).lstrip("/")
    if ".." in inside.split("/"):
        return one
    return replace(one, target=posixpath.relpath(inside or ".", posixpath.dirname(one.path) or "."))


def _is_interpreter(one: Found, venvs: set[str], is_user: bool) -> bool:
    """Whether it is the link of a virtual environment to its Python.

    Raises DoraSystemdError (BAD_INPUT) if others than root can change that Python: it would be a
    part of the release that changes.
    """
    place, name = posixpath.split(one.path)
    venv = posixpath.dirname(place)
    is_python = posixpath.basename(place) == "bin" and name.startswith("python")
    is_one = one.kind == LINK and is_python and venv in venvs and is_plain_path(one.path)
    is_one = is_one and one.target.startswith("/")
    if is_one and one.path.isprintable() and one.target.isprintable():
        if is_user or _is_roots(one.target):
            return True
        reason = f"it links to {one.target}, which others than root can change"
        raise refusal(one.path, reason, _PYTHON_HINT)
    return False


def _is_roots(path: str) -> bool:
    try:
        with reached(path) as (_, place):
            # Not a directory: what is behind it could be a link of anybody.
            is_program = stat.S_ISREG(place.mode) and not path.startswith(("/proc/", "/dev/"))
            return place.is_roots and is_program
    except (OSError, DoraSystemdError):
        return False

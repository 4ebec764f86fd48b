"""`doractl build`: builds the nodes of a dataflow where its files are: `uv sync` and `dora build`.

A build runs as the user who runs the nodes, and never as root. That user can change all that a
build executes, so for root the build has a unit of its own, without our terminal and with no more
than that user's rights. For other callers the build is a child process.
"""

import codecs
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from signal import SIGKILL
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Manager, is_at_rest
from dora_systemd.decisions.cell.environment import unit_environment
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.options import build_command
from dora_systemd.decisions.cell.uv import LOCK, find_lock, uv_project
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.life.refusal import parse_refusal
from dora_systemd.decisions.releases.build import (
    BuildTask,
    format_task,
    project_build_properties,
    project_commands,
    project_environment,
)
from dora_systemd.decisions.settings.table import (
    DORA,
    ENV,
    ENV_FILE,
    USER,
    UV,
    VENV,
    WORKING_DIRECTORY,
)
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.scope import Scope, scope_of
from dora_systemd.trust.programs import own_account, spawn
from dora_systemd.trust.sight import sight_of
from dora_systemd.values import shell_word, shown
from dora_systemd.verbs.facts.reason import exit_status, failure_reason
from dora_systemd.verbs.releases.build import stopped_after_error
from dora_systemd.verbs.releases.source import project_root
from dora_systemd.verbs.start.check import exec_start
from dora_systemd.verbs.start.read import Files, read_files
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.settings import settings_of
from dora_systemd.verbs.start.where import (
    Look,
    account_of,
    caller_variables,
    choose_user,
    find_uv,
    given_variables,
    working_directory,
)

SETTINGS = (UV, VENV, DORA, USER, WORKING_DIRECTORY, ENV, ENV_FILE)
"""Settings that matter for a build."""
_LIBEXEC = str(Path(__file__).parents[1] / "libexec/builds")
_CHUNK = 65536
_MOST_REFUSAL = 8192
_END_SECONDS = 5.0
_LOOK_SECONDS = 0.05
_FORBIDDEN = 200
"""Exit statuses from this one on are systemd's own, see systemd.exec(5)."""

Show = Callable[[str], None]
"""Prints what a build has printed; raises BrokenPipeError."""


class Project(NamedTuple):
    """A project to build."""

    dataflow: str
    user: str  # who builds, "" for the caller
    lock: str  # uv.lock's directory, or ""
    commands: tuple[tuple[str, ...], ...]
    environment: Mapping[str, str]

    @property
    def task(self) -> BuildTask:
        """The task of the program in the build's unit."""
        path = str(PurePath(self.dataflow).parent)
        return BuildTask(shown(self.dataflow), "", "", path, self.commands, is_shown=True)


class Read(NamedTuple):
    """A request to build, and what has been read for it."""

    scope: Scope
    request: StartRequest
    files: Files
    dataflow: Dataflow
    look: Look


def build(
    connect: Callable[[], Manager], scope: Scope, request: StartRequest, show: Show
) -> Project:
    """Build the project of the dataflow file that `request` names. connect: reaches systemd.

    show: gets the output of the build while it runs. Raises DoraSystemdError.
    """
    project = find_project(scope, request)
    command = build_command(sys.executable, format_task(project.task))
    run = _Runner(show)
    if project.user:
        status = _run_unit(connect(), project, command, run)
    else:
        status = _run_child(project, command, run)
    if refusal := parse_refusal(run.refusal, status):
        raise refusal
    if status:
        reason = " ".join(run.refusal.split()) or str(exit_of(status))
        raise DoraSystemdError(f"cannot build {shown(project.dataflow)}: {reason}")
    return project


def find_project(scope: Scope, request: StartRequest) -> Project:
    """Read and check what is to be built, and by whom. Raises DoraSystemdError."""
    is_root = os.geteuid() == 0
    if is_root and scope.is_user:
        raise usage_error("cannot build as root", "leave --user out: the owner of the files builds")
    scope, files = scope_of(is_user=not is_root), read_files(request)
    settings = settings_of(scope, files, request)
    directory = working_directory(files, settings)
    user = choose_user(scope, settings[USER], files.place, directory, settings.source(USER))
    with sight_of(account_of(user)) as sight:
        read = Read(scope, request, files, files.dataflow(), Look(sight, settings, user, directory))
        _check_user(read)
        return _project(read)


def _check_user(read: Read) -> None:
    """Raise DoraSystemdError for a user who cannot build there."""
    user, path = read.look.user, read.dataflow.source
    if user is not None and user.pw_uid == 0:
        hint = "choose who builds with --uid USER"
        raise _refusal(path, "it would run as root", hint, ExitCode.USAGE)
    directory = str(PurePath(path).parent)
    if not read.look.sight.is_writable(directory):
        who = "you" if user is None else f"user {user.pw_name}"
        hint = "its owner can build it, or you in a copy of your own"
        if user is not None:
            hint = f"chown -R {user.pw_name} {shell_word(directory)}, or choose who builds with "
            hint += "--uid USER; doractl deploy builds in a release"
        reason = f"{who} cannot write in {shown(directory)}"
        raise _refusal(path, reason, hint, ExitCode.NO_PERMISSION)


def _project(read: Read) -> Project:
    settings, look, path = read.look.settings, read.look, read.dataflow.source
    home = str(Path.home()) if look.user is None else look.user.pw_dir
    search_path = read.request.search_path
    lock = _find_lock(read)
    uv = find_uv(search_path, look.sight, home)
    if lock and not uv:
        reason = f"{shown(f'{lock}/{LOCK}')} needs uv, which is not in PATH"
        raise _refusal(path, reason, "install uv, see https://docs.astral.sh/uv")
    venv = _venv_of(read, lock) if lock else look.find_venv(path, read.request.environment)
    dora = _find_dora(read, venv, search_path, is_made=bool(lock))
    called = caller_variables(read.scope, read.request, read.files, read.dataflow)
    variables = {**called, **given_variables(settings, look.sight)}
    given = unit_environment(search_path, None, variables)
    places = (_LIBEXEC, *([str(PurePath(uv).parent)] if uv else []))
    more = [one for one in places if one not in search_path.split(os.pathsep)]
    has_home = home != "/" and look.sight.is_writable(home)
    environment = project_environment(given, venv, more, has_home)
    commands = project_commands(path, lock, uv, dora, settings[UV])
    user = "" if look.user is None else look.user.pw_name
    return Project(path, user, lock, commands, environment)


def _find_lock(read: Read) -> str:
    """The directory of the project's uv.lock, "" without one, or if its .venv is not the nodes'."""
    look, path = read.look, PurePath(read.dataflow.source)
    root = project_root(Path(path), look.directory)
    places = [str(path.parent), root]
    if look.settings[UV] and (above := uv_project(look.directory, look.sight.read)):
        places.insert(0, above)
    found = find_lock(places, look.sight.exists)
    given = look.settings[VENV]
    is_own = given is None or str(Path(given).absolute()).startswith(f"{found}/")
    return found if is_own else ""


def _venv_of(read: Read, lock: str) -> str:
    """Return the path of the virtual environment that uv creates, where `start` searches it."""
    given = read.look.settings[VENV]
    if given is not None:
        return str(Path(given).absolute())
    # What `uv run` starts has that of its project.
    place = lock if read.look.settings[UV] else str(PurePath(read.dataflow.source).parent)
    return f"{place}/.venv"


def _find_dora(read: Read, venv: str | None, search_path: str, is_made: bool) -> str:
    """The dora command. is_made: uv may install it into `venv`, which comes first on PATH."""
    try:
        return read.look.find_dora(venv, search_path)
    except DoraSystemdError as error:
        if error.code is ExitCode.NO_DORA and is_made:
            return "dora"
        raise


def _refusal(
    path: str, reason: str, hint: str, code: ExitCode = ExitCode.BAD_INPUT
) -> DoraSystemdError:
    return DoraSystemdError(f"cannot build {shown(path)}: {reason}", hint, code)


class _Runner:
    """Reads both streams of a build. refusal: what it has written to standard error, bounded."""

    def __init__(self, show: Show) -> None:
        self._show = show
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self._refusal = b""

    @property
    def refusal(self) -> str:
        return self._refusal.decode(errors="replace")

    def read(self, stdout: int, stderr: int) -> None:
        """Read both pipes to their ends."""
        poll, left = select.poll(), {stdout, stderr}
        for fd in left:
            poll.register(fd, select.POLLIN)
        while left:
            for fd, _ in poll.poll():
                if data := os.read(fd, _CHUNK):
                    self._take(data, is_refusal=fd == stderr)
                else:
                    poll.unregister(fd)
                    left.discard(fd)

    def _take(self, data: bytes, is_refusal: bool) -> None:
        if is_refusal:
            self._refusal += data[: _MOST_REFUSAL - len(self._refusal)]
        elif text := self._decoder.decode(data):
            self._show(text)


def _run_child(project: Project, command: Sequence[str], run: _Runner) -> int:
    """Build as the caller; the exit status of the program."""
    kept = {key: value for key, value in os.environ.items() if key != "PWD"}
    environment = {**kept, **project.environment}
    child = spawn(command, own_account(), environment, "/", stdin=subprocess.PIPE)
    assert child.stdin and child.stdout and child.stderr
    with child:
        try:
            run.read(child.stdout.fileno(), child.stderr.fileno())
            return child.wait()
        except BaseException:
            child.stdout.close()
            child.stdin.close()  # the build ends with it
            child.wait(_END_SECONDS)
            raise


def _run_unit(manager: Manager, project: Project, command: Sequence[str], run: _Runner) -> int:
    """Build in a unit, as the user of the project; the exit status of the program."""
    unit = f"doractl-build-{os.urandom(8).hex()}.service"
    with _pipes() as (theirs, ours), stopped_after_error(manager, unit):
        stdin, stdout, stderr = theirs
        sent = [
            *project_build_properties(project.user, project.environment).values(),
            ("Description", "s", f"build of {shown(project.dataflow)}"),
            exec_start(command),
            ("StandardInputFileDescriptor", "h", stdin),
            ("StandardOutputFileDescriptor", "h", stdout),
            ("StandardErrorFileDescriptor", "h", stderr),
            # What a build leaves may ignore another signal, and the unit would fail by that.
            ("KillSignal", "i", int(SIGKILL)),
            ("CollectMode", "s", "inactive-or-failed"),
            ("AddRef", "b", True),
        ]
        manager.start_transient(unit, sent, None, wait=False)
        for fd in theirs:
            os.close(fd)
        theirs.clear()
        run.read(*ours[1:])
        while not is_at_rest(manager.read(unit, ["ActiveState", "Job"])):
            time.sleep(_LOOK_SECONDS)
    status = exit_status(manager, unit)
    if status is None or status >= _FORBIDDEN:
        raise _refusal(project.dataflow, failure_reason(manager, unit), "", ExitCode.FAILURE)
    return status


@contextmanager
def _pipes() -> Iterator[tuple[list[int], list[int]]]:
    """Open the ends of a unit's streams, and ours: standard input, output and error."""
    reading, writing = os.pipe2(os.O_CLOEXEC)
    theirs, ours = [reading], [writing]
    try:
        for _ in range(2):
            reading, writing = os.pipe2(os.O_CLOEXEC)
            theirs.append(writing)
            ours.append(reading)
        yield theirs, ours
    finally:
        for fd in (*theirs, *ours):
            os.close(fd)

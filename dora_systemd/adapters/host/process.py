"""Runs child processes to their end, and finds the dora command."""

import contextlib
import os
import re
import selectors
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar, cast

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import Account, fresh_environment, spawn
from dora_systemd.trust.sight import OwnSight, Sight

T = TypeVar("T")

OLDEST_DORA = (1, 0)
"""The oldest supported version: before 1.0 the control protocol was different."""
RECOMMENDED_DORA = (1, 1)

OUTPUT_LIMIT = 4 * 1024 * 1024
"""Maximum bytes kept of each output stream of a child."""
DORA_SECONDS = 60.0

_CHUNK = 65536
_INSTALL_HINT = "pip install dora-rs-cli, install the package dora-cli, or give --dora PATH"


@dataclass(frozen=True)
class Completed:
    """The result of a child: exit status (minus the signal number if killed) and output."""

    status: int
    stdout: str
    stderr: str


def run_command(
    command: Sequence[str],
    seconds: float,
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
    account: Account | None = None,
) -> Completed:
    """Run a child until it exits, without input; keep OUTPUT_LIMIT bytes of each stream.

    environment, account: as for programs.spawn. After `seconds`, its whole process group is killed.
    Raises DoraSystemdError if it must not run, cannot run or takes too long.
    """
    try:
        child = spawn(command, account, environment, directory)
    except OSError as error:
        raise DoraSystemdError(f"cannot run {command[0]}: {error.strerror}") from error
    with child:
        try:
            assert child.stdout and child.stderr
            pipes = (child.stdout.fileno(), child.stderr.fileno())
            streams = _collect(pipes, time.monotonic() + seconds, command[0])
        except BaseException:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            raise
        return Completed(child.wait(), *(one.decode(errors="replace") for one in streams))


class Beside(Generic[T]):
    """Runs a function in a thread, for calls that wait for child processes.

    Not a daemon thread, so that a child is reaped even if nothing uses the result.
    """

    def __init__(self, call: Callable[[], T]) -> None:
        self._call = call
        self._result: T | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._result = self._call()
        except Exception as error:
            self._error = error

    def result(self) -> T:
        """Wait for the function; its result. Raises what it raised."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return cast(T, self._result)


def run_dora(
    dora: str,
    arguments: Sequence[str],
    account: Account | None,
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
) -> Completed:
    """Run a dora command that ends by itself, such as `dora validate`, without colours.

    account: the user to run it as; None: then root may only run a dora that belongs to root.
    """
    own = os.environ if account is None else fresh_environment(account)
    surroundings = {**(own if environment is None else environment)}
    surroundings |= {"RUST_BACKTRACE": "0", "NO_COLOR": "1"}
    return run_command((dora, *arguments), DORA_SECONDS, surroundings, directory, account)


def find_dora(
    given: str | None, venv: str | None, search_path: str, sight: Sight | None = None
) -> str:
    """Absolute path of the dora command: `given`, else that of `venv`, else on `search_path`.

    The last place is beside our own Python: pip puts both into one virtual environment, and often
    only doractl is linked into PATH. sight: the permissions to look with. Raises DoraSystemdError
    (NO_DORA).
    """
    sight = sight or OwnSight()
    if given is not None:
        found = _which(given, search_path.split(os.pathsep), sight)
        if found is None:
            raise DoraSystemdError(
                f"cannot run the dora command {given}", _INSTALL_HINT, ExitCode.NO_DORA
            )
        return found
    last = str(Path(sys.executable).parent)
    places = [*([f"{venv}/bin"] if venv else []), *search_path.split(os.pathsep), last]
    found = _which("dora", places, sight)
    if found is None:
        raise DoraSystemdError("cannot find the dora command", _INSTALL_HINT, ExitCode.NO_DORA)
    return found


def _which(name: str, places: Sequence[str], sight: Sight) -> str | None:
    paths = [name] if "/" in name else [f"{place}/{name}" for place in places if place]
    return next(filter(sight.is_program, (str(Path(one).absolute()) for one in paths)), None)


def dora_version(
    dora: str, account: Account | None = None, environment: Mapping[str, str] | None = None
) -> str:
    """The version of a dora command, as in "1.1.0". account, environment: as for run_dora.

    Raises DoraSystemdError (NO_DORA) if it is not dora, or older than OLDEST_DORA.
    """
    done = run_dora(dora, ["--version"], account, environment)
    version = parse_dora_version(done.stdout) if done.status == 0 else None
    if version is None:
        words = " ".join((done.stderr or done.stdout).split())[:200]
        raise DoraSystemdError(
            f"cannot use {dora} as dora command: {words or 'it tells no version'}",
            _INSTALL_HINT,
            ExitCode.NO_DORA,
        )
    if version_numbers(version) < OLDEST_DORA:
        raise DoraSystemdError(
            f"cannot use {dora}: it is dora {version}, 1.0 or newer is needed",
            "pip install --upgrade dora-rs-cli",
            ExitCode.NO_DORA,
        )
    return version


def parse_dora_version(text: str) -> str | None:
    """The version in "dora-cli 1.1.0", or None."""
    match = re.match(r"dora(?:-cli)?\s+(\d+\.\d+\S*)", text)
    return match[1] if match else None


def version_numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version: (1, 1, 0) for "1.1.0-rc.1"."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(map(int, match[0].split("."))) if match else ()


def read_streams(streams: Sequence[int], seconds: float) -> list[bytes]:
    """Read pipes until their end, and close them. Raises DoraSystemdError after `seconds`."""
    try:
        return _collect(streams, time.monotonic() + seconds, "a check")
    finally:
        for fd in streams:
            os.close(fd)


def _collect(streams: Sequence[int], deadline: float, command: str) -> list[bytes]:
    """Read all streams until their end; drop what exceeds the limit."""
    kept = {fd: bytearray() for fd in streams}
    with selectors.DefaultSelector() as selector:
        for stream in kept:
            selector.register(stream, selectors.EVENT_READ)
        while selector.get_map():
            left = deadline - time.monotonic()
            if left <= 0:
                raise DoraSystemdError(f"cannot wait for {command!r} any longer: it hangs")
            for key, _ in selector.select(left):
                chunk = os.read(key.fd, _CHUNK)
                kept[key.fd] += chunk[: OUTPUT_LIMIT - len(kept[key.fd])]
                if not chunk:
                    selector.unregister(key.fd)
    return [bytes(one) for one in kept.values()]

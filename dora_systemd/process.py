"""Child processes: find the dora command, run it once, read what it said."""

import contextlib
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar, cast

from dora_systemd.errors import DoraSystemdError, ExitCode

T = TypeVar("T")

OLDEST_DORA = (1, 0)
"""Before 1.0 the control protocol was another one."""
RECOMMENDED_DORA = (1, 1)

OUTPUT_LIMIT = 4 * 1024 * 1024
"""Bytes kept of each stream of a child."""
DORA_SECONDS = 60.0

_CHUNK = 65536
_INSTALL_HINT = "pip install dora-rs-cli, install the package dora-cli, or give --dora PATH"


@dataclass(frozen=True)
class Completed:
    """How a child ended: exit status (minus the signal number when killed) and its two streams."""

    status: int
    stdout: str
    stderr: str


@dataclass(frozen=True)
class Account:
    """The user whom a child runs as, with all groups."""

    uid: int
    gid: int
    groups: tuple[int, ...] = ()


def run_command(
    command: Sequence[str],
    seconds: float,
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
    account: Account | None = None,
) -> Completed:
    """Run a child to its end, with no input; of each stream OUTPUT_LIMIT bytes are kept.

    After `seconds` its whole process group is killed. Raises DoraSystemdError when it cannot be
    run or took too long.
    """
    try:
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            cwd=directory,
            start_new_session=True,
            user=None if account is None else account.uid,
            group=None if account is None else account.gid,
            extra_groups=None if account is None else account.groups,
        )
    except OSError as error:
        raise DoraSystemdError(f"cannot run {command[0]}: {error.strerror}") from error
    with child:
        try:
            streams = _collect(child, time.monotonic() + seconds)
        except BaseException:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            raise
        return Completed(child.wait(), *(one.decode(errors="replace") for one in streams))


class Beside(Generic[T]):
    """A call in a thread of its own, for those that wait for children.

    No daemon thread: the child of one that nobody waits for any more is still waited for.
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
        """What the call has returned, once it has. Raises what the call raised."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return cast(T, self._result)


def run_dora(
    dora: str,
    arguments: Sequence[str],
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
    account: Account | None = None,
) -> Completed:
    """Run a dora command that ends by itself, such as `dora validate`, without colours."""
    surroundings = {**(os.environ if environment is None else environment)}
    surroundings |= {"RUST_BACKTRACE": "0", "NO_COLOR": "1"}
    return run_command((dora, *arguments), DORA_SECONDS, surroundings, directory, account)


def find_dora(given: str | None, venv: str | None, search_path: str) -> str:
    """Absolute path of the dora command: the one given, else of the venv, else on `search_path`.

    Last comes that beside our own Python: pip has put both into one virtual environment, and what
    is linked onto PATH is only doractl. Raises DoraSystemdError (NO_DORA).
    """
    if given is not None:
        found = shutil.which(given, path=search_path)
        if found is None:
            raise DoraSystemdError(
                f"cannot run the dora command {given}", _INSTALL_HINT, ExitCode.NO_DORA
            )
        return str(Path(found).absolute())
    places = [*([f"{venv}/bin"] if venv else []), search_path, str(Path(sys.executable).parent)]
    found = shutil.which("dora", path=os.pathsep.join(places))
    if found is None:
        raise DoraSystemdError("cannot find the dora command", _INSTALL_HINT, ExitCode.NO_DORA)
    return str(Path(found).absolute())


def dora_version(dora: str, account: Account | None = None) -> str:
    """The version of a dora command, as in "1.1.0".

    Raises DoraSystemdError (NO_DORA) if it is none, or older than OLDEST_DORA.
    """
    done = run_dora(dora, ["--version"], account=account)
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


def _collect(child: "subprocess.Popen[bytes]", deadline: float) -> tuple[bytes, bytes]:
    """Both streams until their end; what exceeds the limit is read and dropped."""
    assert child.stdout and child.stderr
    kept = {child.stdout.fileno(): bytearray(), child.stderr.fileno(): bytearray()}
    with selectors.DefaultSelector() as selector:
        for stream in kept:
            selector.register(stream, selectors.EVENT_READ)
        while selector.get_map():
            left = deadline - time.monotonic()
            if left <= 0:
                command = child.args[0] if isinstance(child.args, (list, tuple)) else child.args
                raise DoraSystemdError(f"cannot wait for {command!r} any longer: it hangs")
            for key, _ in selector.select(left):
                chunk = os.read(key.fd, _CHUNK)
                kept[key.fd] += chunk[: OUTPUT_LIMIT - len(kept[key.fd])]
                if not chunk:
                    selector.unregister(key.fd)
    stdout, stderr = kept.values()
    return bytes(stdout), bytes(stderr)

"""What another account is asked about paths, and what a hostile one can do with that."""

import errno
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import Account, own_account
from dora_systemd.trust.sight import LentSight, Sight, receive, send, sight_of, start_reader
from tests.unit.fakes.programs import make_program

LONG = "/" + "x" * 4000
"""A pipe is full after some of these."""
OTHER = Account(65534, 65534, (65534,), "nobody")


def test_answers_to_questions_that_nobody_reads() -> None:
    """The account can trace the child and have it say yes to all, without a look."""
    command = ["sh", "-c", "exec yes +00000011 | tr -d '\\n'"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as child:
        sight = LentSight(child, own_account(), 2.0)
        assert sight.exists("/nowhere")
        with pytest.raises(DoraSystemdError, match="no answer"):
            for number in range(64):
                sight.exists(f"{LONG}{number}")
        child.kill()


@pytest.mark.parametrize("said", ["+00000011", "-00000012"])
def test_an_answer_is_kept(said: str) -> None:
    """What is decided by an answer is decided by the same one; the child sends it once."""
    with subprocess.Popen(["sh", "-c", f"printf %s {said}; cat >&2"], stdin=-1, stdout=-1) as child:
        sight = LentSight(child, own_account(), 2.0)
        assert [sight.exists("/x") for _ in range(3)] == [said[0] == "+"] * 3
        with pytest.raises(DoraSystemdError, match="no answer"):
            LentSight(child, own_account(), 0.05).exists("/x")
        child.kill()


def can_run_python(account: Account) -> bool:
    """Whether `account` may execute this Python, which may lie in a home."""
    command, uid, gid = [sys.executable, "-Ic", ""], account.uid, account.gid
    try:
        subprocess.run(command, user=uid, group=gid, extra_groups=[], check=True)
    except (OSError, subprocess.SubprocessError):
        return False
    return True


@pytest.fixture(params=["own", "other"])
def sight(request: pytest.FixtureRequest) -> Iterator[Sight]:
    """That of the caller, and of another user; the answers are the same."""
    if request.param == "other" and not can_run_python(OTHER):
        pytest.skip("only root can ask as another user, and if that user can run this Python")
    with sight_of(None if request.param == "own" else OTHER) as found:
        yield found


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory that everybody may enter."""
    with TemporaryDirectory(dir="/tmp") as name:
        Path(name).chmod(0o755)
        yield Path(name)


def test_what_is_there(sight: Sight, place: Path) -> None:
    make_program(place / "program", "exit")
    (place / "link").symlink_to("program")
    (place / "text").write_text("words")
    os.utime(place / "text", ns=(5, 1_767_225_600_000_000_001))
    (place / "text").chmod(0o644)
    table = {
        "program": (True, False, True),
        "link": (True, False, True),
        "text": (True, False, False),
        "": (True, True, False),
        "missing": (False, False, False),
        "text/below": (False, False, False),
    }
    for name, answers in table.items():
        path = str(place / name)
        assert (sight.exists(path), sight.is_directory(path), sight.is_program(path)) == answers
    assert sight.real(str(place / "link")) == str((place / "program").resolve())
    assert sight.real(str(place / "missing")) == str(place.resolve() / "missing")
    assert sight.real("/\0") == "/\0"
    assert sight.read(str(place / "text")) == b"words"
    assert sight.modified_ns(str(place / "text")) == 1_767_225_600_000_000_001
    assert sight.modified_ns(str(place / "missing")) == 0
    (place / "text").write_text("x" * 1000)
    assert sight.head(str(place / "text")) == b"x" * 256
    with pytest.raises(FileNotFoundError):
        sight.head(str(place / "missing"))


def test_names_that_begin_alike(sight: Sight, place: Path) -> None:
    for name in ("dora_rs-1", "dora_rs-2", "dora_rs_cli-1", "x"):
        (place / name).mkdir()
    assert sorted(sight.names(f"{place}/dora_rs-")) == ["dora_rs-1", "dora_rs-2"]
    assert sight.names(f"{place}/y") == sight.names(f"{place}/missing/x") == []
    assert sight.names(f"{place}/\0") == []
    for number in range(40):
        (place / f"many-{number}").mkdir()
    assert len(sight.names(f"{place}/many-")) == 16


@pytest.mark.parametrize(
    ("name", "number"),
    [
        *(("missing", errno.ENOENT), ("", errno.EISDIR), ("fifo", errno.ENXIO)),
        *(("x" * 5000, errno.ENAMETOOLONG), ("\0", errno.EINVAL)),
    ],
)
def test_what_cannot_be_read(sight: Sight, place: Path, name: str, number: int) -> None:
    os.mkfifo(place / "fifo", 0o644)
    with pytest.raises(OSError) as caught:
        sight.read(str(place / name))
    assert (caught.value.errno, caught.value.strerror) == (number, os.strerror(number))


def test_an_interpreter_that_the_account_cannot_reach() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        start_reader(("/nowhere/python",), own_account())
    name = own_account().name
    assert caught.value.message == (
        f"cannot start the dataflow as user {name}, who cannot reach {sys.executable}"
    )
    assert caught.value.hint == (
        f"see namei -l {sys.executable}: move it, chmod a+rX what is closed, "
        "or choose another user with --uid"
    )
    assert caught.value.code is ExitCode.NO_PERMISSION


def test_a_child_that_is_silent() -> None:
    with subprocess.Popen(["sleep", "60"], stdin=-1, stdout=-1) as child:
        with pytest.raises(DoraSystemdError) as caught:
            LentSight(child, own_account(), 0.05).exists("/x")
        child.kill()
    assert caught.value.message == f"cannot look at /x as user {own_account().name}: no answer"
    assert caught.value.hint == "see whether a mount of that user hangs"


@pytest.mark.parametrize(
    ("said", "number"),
    [("-00000012", 2), ("-0000001x", errno.EINVAL), ("-000000599999", errno.EINVAL)],
)
def test_an_error_that_a_child_tells(said: str, number: int) -> None:
    with subprocess.Popen(["sh", "-c", f"printf %s {said}; cat"], stdin=-1, stdout=-1) as child:
        with pytest.raises(OSError) as caught:
            LentSight(child, own_account()).read("/x")
        child.kill()
    assert caught.value.errno == number


class Pipe(NamedTuple):
    """The two ends of a pipe."""

    reading: int
    writing: int


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    one = Pipe(*os.pipe())
    yield one
    for fd in one:
        os.close(fd)


def soon(seconds: float = 20.0) -> float:
    return time.monotonic() + seconds


def test_all_of_it_arrives(pipe: Pipe) -> None:
    """Also what is more than a pipe holds, and more than one read gets."""
    data = os.urandom(300_000)
    sender = threading.Thread(target=send, args=(pipe.writing, data + b"rest", soon()))
    sender.start()
    assert receive(pipe.reading, len(data), soon()) == data
    assert receive(pipe.reading, 4, soon()) == b"rest"
    sender.join()


def test_nothing_is_nothing(pipe: Pipe) -> None:
    send(pipe.writing, b"", soon(-1))
    assert receive(pipe.reading, 0, soon(-1)) == b""


def test_what_is_there_needs_no_time(pipe: Pipe) -> None:
    send(pipe.writing, b"word", soon(-1))
    assert receive(pipe.reading, 4, soon(-1)) == b"word"


def test_who_takes_nothing_is_not_waited_for(pipe: Pipe) -> None:
    with pytest.raises(BrokenPipeError):
        send(pipe.writing, bytes(1_000_000), soon(0.05))


@pytest.mark.parametrize("said", [b"", b"wor"])
def test_who_says_too_little_is_not_waited_for(pipe: Pipe, said: bytes) -> None:
    os.write(pipe.writing, said)
    with pytest.raises(BrokenPipeError):
        receive(pipe.reading, 4, soon(0.05))


def test_who_ends_has_said_all() -> None:
    reading, writing = os.pipe()
    os.write(writing, b"wor")
    os.close(writing)
    with pytest.raises(BrokenPipeError):
        receive(reading, 4, soon())
    os.close(reading)


def test_who_can_be_written_to_has_said_nothing() -> None:
    """A socket is ready for one direction, and not for the other."""
    own, other = socket.socketpair()
    with own, other:
        with pytest.raises(BrokenPipeError):
            receive(own.fileno(), 1, soon(0.05))
        own.setblocking(False)
        with pytest.raises(BlockingIOError):
            while True:
                own.send(bytes(65536))
        other.send(b"x")
        with pytest.raises(BrokenPipeError):
            send(own.fileno(), b"y", soon(0.05))

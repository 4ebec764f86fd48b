"""Programs run as whose they are, with nothing of root's, and root runs only its own."""

import os
import pwd
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import (
    Account,
    account_from,
    account_of_uid,
    check_program,
    end_child,
    fresh_environment,
    own_account,
    require_user,
    spawn,
)

TRACE = """
import ctypes, sys, time
ptrace = ctypes.CDLL(None).ptrace
ptrace.argtypes = [ctypes.c_long] * 4
print(ptrace(0x4206, int(sys.argv[1]), 0, 0), flush=True)  # PTRACE_SEIZE
time.sleep(100)
"""
# PR_SET_PTRACER: any process of the same user may trace this one, whatever Yama says.
TRACED = """
import ctypes, time
ctypes.CDLL(None).prctl(0x59616D61, ctypes.c_ulong(-1), 0, 0, 0)
print(flush=True)
time.sleep(100)
"""

FIND_KEY = """
import ctypes, sys
search = ctypes.CDLL(None).syscall
print(search(int(sys.argv[1]), 10, -3, b"user", b"of-the-caller", 0) > 0)  # KEYCTL_SEARCH
"""
KEEP_KEY = """
import ctypes, os, sys
from dora_systemd.trust import programs, terminals
libc = ctypes.CDLL(None)
number, add = (250, 248) if os.uname().machine == "x86_64" else (219, 217)
libc.syscall(number, 1, None)
if libc.syscall(add, b"user", b"of-the-caller", b"x", 1, ctypes.c_long(-3)) < 0:
    sys.exit(77)
command = ["/usr/bin/env", "python3", "-c", sys.argv[2], str(number)]
account = programs.Account(65534, 65534, (), "nobody")
if sys.argv[1] == "caller":
    account = programs.own_account()
if sys.argv[1] == "terminal":
    sys.exit(terminals.run_apart(command, {"PATH": programs.DEFAULT_PATH}, account))
sys.stdout.write(programs.spawn(command, account, directory="/").communicate()[0].decode())
"""

root_only = pytest.mark.skipif(os.getuid() != 0, reason="becomes somebody else")
NOBODY, GONE = 65534, 3_999_999_999


def script(path: Path, text: str = "#!/bin/sh\n", owner: int = 0) -> str:
    path.write_text(text)
    path.chmod(0o755)
    os.chown(path, owner, owner)
    return str(path)


def output(command: list[str], account: Account | None) -> str:
    with spawn(command, account, directory="/") as child:
        return child.communicate(timeout=30)[0].decode()


@root_only
def test_a_fresh_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "x")
    account = account_of_uid(NOBODY)
    found = dict(line.split("=", 1) for line in output(["/usr/bin/env"], account).splitlines())
    assert found == fresh_environment(account)
    assert (found["USER"], found["HOME"]) == ("nobody", pwd.getpwuid(NOBODY).pw_dir)
    assert output(["/usr/bin/id", "-u"], account).strip() == str(NOBODY)
    assert set(output(["/usr/bin/id", "-G"], account).split()) == {
        str(group) for group in os.getgrouplist("nobody", account.gid)
    }


@root_only
def test_root_runs_only_its_own(place: Path) -> None:
    check_program("sh")
    check_program("/usr/bin/env")
    check_program(script(place / "own", "#!/usr/bin/env -S sh -e\n"))
    check_program("/nowhere/x")
    theirs = script(place / "theirs", owner=NOBODY)
    link = place / "link"
    link.symlink_to(theirs)
    shared = script(place / "shared")
    Path(shared).chmod(0o777)
    behind = script(place / "behind", f"#!{theirs}\n")
    for program in (theirs, str(link), shared, behind):
        with pytest.raises(DoraSystemdError, match="as root") as caught:
            check_program(program)
        assert caught.value.code is ExitCode.NO_PERMISSION
    with pytest.raises(DoraSystemdError):
        spawn([theirs], None)
    assert output([script(place / "id", "#!/bin/sh\nid -u\n", NOBODY)], account_of_uid(NOBODY))


@root_only
def test_the_program_that_would_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one on PATH that can be executed; a directory and other files are no programs."""
    for name in ("first", "second", "third"):
        (place / name).mkdir()
    (place / "first/tool").mkdir()
    (place / "second/tool").write_text("no program")
    script(place / "third/tool", owner=NOBODY)
    monkeypatch.setenv("PATH", ":".join(f"{place}/{name}" for name in ("first", "second", "third")))
    with pytest.raises(DoraSystemdError, match=r"/third/tool as root: nobody can"):
        check_program("tool")
    check_program("missing")


@root_only
def test_a_directory_of_others_is_enough(place: Path) -> None:
    below = place / "below"
    below.mkdir()
    program = script(below / "own")
    check_program(program)
    os.chown(below, NOBODY, NOBODY)
    with pytest.raises(DoraSystemdError, match="nobody can change it"):
        check_program(program)


@pytest.mark.parametrize(
    ("uid", "name", "message"),
    [
        (NOBODY, "nobody", ""),
        (NOBODY, "a-name-for-nodes", ""),
        (GONE, "nobody", ""),
        (GONE, "", ""),
        (GONE, "robot-gone", "cannot start again as the user robot-gone: there is none any more"),
    ],
)
def test_a_user_that_was_deleted(uid: int, name: str, message: str) -> None:
    found = ""
    try:
        require_user(uid, name)
    except DoraSystemdError as error:
        found = error.message
    assert found == message


def test_the_own_account_needs_no_change() -> None:
    account = own_account()
    assert account.uid == os.geteuid()
    command = [sys.executable, "-c", "print('ran')"]
    child = spawn(command, account, os.environ, stderr=subprocess.DEVNULL)
    assert child.communicate(timeout=30)[0] == b"ran\n"


def test_a_user_that_is_gone() -> None:
    for uid in (4_000_000, 2**32 - 1, 2**40):
        with pytest.raises(DoraSystemdError, match="there is none") as caught:
            account_of_uid(uid)
        assert caught.value.code is ExitCode.NOT_FOUND
    assert account_from(pwd.getpwuid(0)).home == "/root"


def test_a_child_that_another_process_traces_is_not_waited_for() -> None:
    """The kernel reports the end of a child to its tracer first."""
    child = spawn([sys.executable, "-c", TRACED], own_account(), stdin=subprocess.PIPE)
    assert child.stdout
    assert child.stdout.readline()
    command = [sys.executable, "-c", TRACE, str(child.pid)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as tracer:
        assert tracer.stdout
        assert tracer.stdout.readline() == b"0\n"
        begun = time.monotonic()
        end_child(child)
        assert time.monotonic() - begun < 30
        assert child.returncode is None
        tracer.kill()
    assert child.wait(30) == -signal.SIGKILL


def test_a_child_ends_although_another_process_has_its_streams() -> None:
    child = spawn(["sleep", "100"], own_account(), stdin=subprocess.PIPE)
    with Path(f"/proc/{child.pid}/fd/2").open("wb"):
        end_child(child)
    assert child.returncode == -signal.SIGKILL
    assert [one.closed for one in (child.stdin, child.stdout, child.stderr) if one] == [True] * 3


@root_only
@pytest.mark.parametrize(
    ("who", "expected"), [("caller", "True"), ("other", "False"), ("terminal", "False")]
)
def test_nobody_else_gets_the_keys_of_the_caller(who: str, expected: str) -> None:
    """A key of the session is possessed by all programs in it, whatever user they become."""
    command = [sys.executable, "-c", KEEP_KEY, who, FIND_KEY]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode == 77:
        pytest.skip("no keys here")
    assert done.stdout.strip() == expected, done.stderr

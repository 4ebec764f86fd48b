"""Stacks of core dumps and of Python: whose they are, and what of them is shown."""

from dataclasses import replace
from typing import Any

import pytest

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.why.stack import (
    NATIVE,
    PYTHON,
    Crash,
    Frame,
    crash_of,
    dump_frames,
    dump_matches,
    find_dump,
    is_of_stack,
    plain_name,
    python_frames,
    without_handler,
)
from dora_systemd.decisions.why.verdict import Verdict
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND

UNIT = "dora-robot.service"
DUMP = """Process 42 (camera) of user 1000 dumped core.

Module libgrab.so without build-id.
Stack trace of thread 42:
#0  0x00007f5c0b4a9119 grab_frame (libgrab.so + 0x1119)
#1  0x000055d0c1a011a7 _ZN6Camera4readEv (camera + 0x11a7)
#2  0x000055d0c1a011c9 n/a (camera + 0x11c9)

Stack trace of thread 43:
#0  0x00007f5c0b2a9e2c __poll (libc.so.6 + 0xf5e2c)
ELF object binary architecture: AMD x86-64
"""
FRAMES = (
    Frame(NATIVE, "grab_frame", "libgrab.so + 0x1119"),
    Frame(NATIVE, "Camera::read", "camera + 0x11a7"),
    Frame(NATIVE, "?", "camera + 0x11c9"),
)
CRASH = Crash("camera", 11, 42, 5 * SECOND, 9 * SECOND)
VERDICT = Verdict(
    "Failed",
    Cause.NODE_FAILED,
    node="camera",
    at_us=100 * SECOND,
    began_us=5 * SECOND,
    details={"exit": "signal SIGSEGV", "node_pid": "42"},
)


def dump(**fields: Any) -> dict[str, Any]:
    cgroup = f"/dora.slice/{UNIT}/node-camera"
    own = {"PID": "42", "SIGNAL": "11", "TIMESTAMP": str(8 * SECOND), "CGROUP": cgroup, **fields}
    return {"MESSAGE": DUMP, **{f"COREDUMP_{key}": text for key, text in own.items()}}


def test_the_stack_is_of_the_thread_that_crashed() -> None:
    assert find_dump([dump()], UNIT, CRASH) == FRAMES
    assert str(FRAMES[0]) == "grab_frame (libgrab.so + 0x1119)"


OF_252 = """Process 235 (crash.sh) of user 0 dumped core.

Module dora.abi3.so without build-id.
Stack trace of thread 238:
#0  0x00007ff970cbdeec n/a (libc.so.6 + 0x8aeec)
#1  0x00007ff970c6efb2 raise (libc.so.6 + 0x3bfb2)
#2  0x00007ff970caa994 _IO_puts (libc.so.6 + 0x77994)
#3  0x00007ff970945b0d ffi_call (libffi.so.8 + 0x6b0d)
#4  0x00000000004f9f1b PyEval_EvalCode (/usr/bin/python3.11 + 0xf9f1b)
"""
OF_262 = """Process 309 (crash.sh) of user 0 dumped core.

Module libuuid.so.1 from deb util-linux-2.42.4-1.amd64
Module dora.abi3.so without build-id.
Stack trace of thread 312:
#0  0x00007f33de032d0c n/a (libc.so.6 + 0x96d0c)
#1  0x00007f33ddfdc582 raise (libc.so.6 + 0x40582)
#2  0x00007f33de01dbf2 puts (libc.so.6 + 0x81bf2)
#3  0x00007f33ddc70fe5 ffi_call (libffi.so.8 + 0xafe5)
#4  0x000000000058f09d PyEval_EvalCode (/usr/bin/python3.14 + 0x18f09d)
"""


@pytest.mark.parametrize(("text", "puts"), [(OF_252, "_IO_puts"), (OF_262, "puts")])
def test_the_texts_of_other_versions(text: str, puts: str) -> None:
    """Written by the systemd-coredump of Debian 12 and forky, called by hand with a core file.

    In a container the kernel calls only the program of its host, so no test can do the same there.
    """
    names = [one.function for one in dump_frames(text)]
    assert names == ["?", "raise", puts, "ffi_call", "PyEval_EvalCode"]


@pytest.mark.parametrize(
    "fields",
    [
        {"PID": "43"},
        {"PID": None},
        {"SIGNAL": "6"},
        {"TIMESTAMP": str(10 * SECOND)},  # of the next life
        {"TIMESTAMP": str(3 * SECOND)},  # of the one before
        {"TIMESTAMP": "9" * 5000},
        {"CGROUP": f"/dora.slice/{UNIT}/node-camera2"},
        {"CGROUP": f"/dora.slice/{UNIT}"},
        {"CGROUP": "/dora.slice/dora-other.service/node-camera"},
        {"CGROUP": ["a", f"/{UNIT}/node-lidar"]},
    ],
)
def test_the_stack_is_of_this_process(fields: dict[str, Any]) -> None:
    assert find_dump([dump(**fields)], UNIT, CRASH) is None
    assert find_dump([dump(**fields), dump()], UNIT, CRASH) == FRAMES


def test_the_stack_may_be_of_a_child() -> None:
    below = dump(PID="43", CGROUP=f"/dora.slice/{UNIT}/node-camera/part")
    assert find_dump([below], UNIT, CRASH._replace(pid=None)) == FRAMES


def test_a_dump_without_a_stack() -> None:
    bare = {**dump(), "MESSAGE": "Process 42 (camera) of user 1000 dumped core."}
    assert find_dump([bare], UNIT, CRASH) == ()


def test_a_hostile_dump_is_bounded() -> None:
    line = "#0  0x0000000000000001 {} (x + 0x1)\n"
    many = "Stack trace of thread 1:\n" + line.format("f") * 5000
    assert len(dump_frames(many)) == 20
    (frame,) = dump_frames("Stack trace of thread 1:\n" + line.format("f" * 500))
    assert len(frame.function) == 120
    for text in ("f" * 100_000, "(" * 100_000, " (" * 50_000):
        assert dump_frames("Stack trace of thread 1:\n" + line.format(text)) == ()


@pytest.mark.parametrize(
    ("symbol", "name"),
    [
        ("grab", "grab"),
        ("_Z4grabPKc", "grab"),
        ("_ZN6Camera4readEv", "Camera::read"),
        ("_ZNK6Camera4readEv", "Camera::read"),
        ("_ZN6camera4grab17h0123456789abcdefE", "camera::grab"),
        ("_ZL4grabP7_object.lto_priv.0", "grab"),
        ("_ZN3stdIiE4sortEv", "_ZN3stdIiE4sortEv"),
        ("_ZN17h0123456789abcdefE", "_ZN17h0123456789abcdefE"),
        ("_Z", "_Z"),
        ("_ZN999xE", "_ZN999xE"),
        ("_ZN", "_ZN"),
    ],
)
def test_names(symbol: str, name: str) -> None:
    assert plain_name(symbol) == name


HANDLED = ("?", "raise", "?", "?", "puts", "main")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (HANDLED, ("?", "puts", "main")),
        (("raise", "faulthandler_fatal_error", "__restore_rt", "grab"), ("grab",)),
        (("raise", "grab"), ("grab",)),
        (("raise",), ()),
        (("grab", "a", "b", "raise", "c"), ("grab", "a", "b", "raise", "c")),
        ((), ()),
    ],
)
def test_the_handler_of_python_is_left_out(before: tuple[str, ...], after: tuple[str, ...]) -> None:
    frames = tuple(Frame(NATIVE, one, "x + 0x1") for one in before)
    assert tuple(one.function for one in without_handler(frames)) == after


def test_only_root_can_write_what_matches() -> None:
    slice_ = r"_SYSTEMD_SLICE=system-systemd\x2dcoredump.slice"
    own = ["MESSAGE_ID=fc2e22bc6ee647b6b90729ab34a250b1", f"COREDUMP_UNIT={UNIT}"]
    system = dump_matches(Scope(is_user=False, uid=0), UNIT)
    assert system == [slice_, *own, "+", "_SYSTEMD_UNIT=systemd-coredumpd.service", *own]
    user = dump_matches(Scope(is_user=True, uid=1000), UNIT)
    assert user.count("COREDUMP_UID=1000") == user.count(f"COREDUMP_USER_UNIT={UNIT}") == 2
    assert f"COREDUMP_UNIT={UNIT}" not in user


@pytest.mark.parametrize(
    ("details", "signal", "pid"),
    [
        ({"exit": "signal SIGSEGV", "node_pid": "42"}, 11, 42),
        ({"exit": "signal SIGABRT"}, 6, None),
        ({"exit": "exit code 139", "node_pid": "42"}, 11, None),
    ],
)
def test_crashes(details: dict[str, str], signal: int, pid: int | None) -> None:
    since = 5 * SECOND if pid else 40 * SECOND
    wanted = Crash("camera", signal, pid, since, 100 * SECOND)
    assert crash_of(replace(VERDICT, details=details)) == wanted


def test_a_watchdog_ends_all_processes_of_a_node() -> None:
    hung = {"exit": "hung, no WATCHDOG=1 for 5s", "node_pid": "42"}
    found = crash_of(replace(VERDICT, cause=Cause.NODE_WATCHDOG, details=hung))
    assert found is not None
    assert (found.signal, found.pid) == (6, None)


@pytest.mark.parametrize("exit", ["signal SIGKILL", "exit code 1", "exit code 137", "", "x"])
def test_other_ends_have_no_stack(exit: str) -> None:
    assert crash_of(replace(VERDICT, details={"exit": exit})) is None


def test_the_end_of_a_dataflow_has_no_stack() -> None:
    assert crash_of(replace(VERDICT, node="")) is None


OLD_PYTHON = """Fatal Python error: Segmentation fault

Thread 0x00007f1 [Thread-1 (sleep] (most recent call first):
  File "/usr/lib/python3.11/threading.py", line 324 in wait

Current thread 0x00007f2 (most recent call first):
  File "/home/a b/camera.py", line 12 in read_frame
  File "<string>", line ??? in <module>

Extension modules: numpy.core (total: 1)"""
NEW_PYTHON = """Fatal Python error: Segmentation fault

Current thread 0x00007f2 [python3] (most recent call first):
  File "/home/camera.py", line 12 in read_frame

Current thread's C stack trace (most recent call first):
  Binary file "python3", at _Py_DumpStack+0x34 [0x55d0]
  Binary file "python3" [0x55d1]
  Binary file "/lib/x86_64-linux-gnu/libc.so.6", at +0x3fdf0 [0x7f02]
  Binary file "/home/grab.so", at grab_frame+0x10 [0x7f03]
  Binary file "python3" [0x55d2]

Extension modules: grab (total: 1)"""


def test_python_of_one_thread_among_several() -> None:
    lines = ["before", *OLD_PYTHON.split("\n")][::-1]
    assert python_frames(lines) == (
        Frame(PYTHON, "read_frame", "/home/a b/camera.py:12"),
        Frame(PYTHON, "<module>", "<string>:???"),
    )


def test_python_with_the_calls_of_c() -> None:
    assert python_frames(NEW_PYTHON.split("\n")[::-1]) == (
        Frame(NATIVE, "grab_frame", "/home/grab.so + 0x10"),
        Frame(NATIVE, "?", "python3"),
        Frame(PYTHON, "read_frame", "/home/camera.py:12"),
    )


def test_lines_that_are_no_dump() -> None:
    assert python_frames(['  File "x", line 1 in f', "Current thread 0x1:"]) == ()
    assert python_frames(["anything", "Fatal Python error: Aborted"]) == ()


def test_lines_of_a_dump() -> None:
    for text in (OLD_PYTHON, NEW_PYTHON):
        assert all(is_of_stack(line) for line in text.split("\n"))
    for line in ('  File "x.py", line 3, in read', "frame 5"):
        assert not is_of_stack(line)

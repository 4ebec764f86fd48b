"""`lab run` from the outside: needs root, and the images (built if they are missing)."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.lab.pace import bound

LAB = Path(__file__).with_name("lab")
RUNS = Path("/run/dora-systemd-lab")


FORMS = ["container", "vm"]


@pytest.fixture(scope="session", autouse=True)
def images(request: pytest.FixtureRequest) -> None:
    """Build what is missing, in sight of who waits: what the lab says then is no test's output."""
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        for form in (*FORMS, "emulator"):
            subprocess.run([LAB, "build"], env={**os.environ, "LAB": form}, check=True)


@pytest.fixture(params=FORMS)
def env(request: pytest.FixtureRequest) -> Iterator[dict[str, str]]:
    yield {**os.environ, "LAB": request.param}
    assert_nothing_left()


def lab(env: dict[str, str], *arguments: str, given: bytes = b"") -> tuple[int, bytes, bytes]:
    done = subprocess.run([LAB, *arguments], env=env, input=given, capture_output=True, check=False)
    return done.returncode, done.stdout, done.stderr


def own_runs() -> set[str]:
    return {path.name for path in RUNS.glob("lab-*")}


def assert_nothing_left() -> None:
    """No run of a dead lab; those of other people at the same time have a living one."""
    for _ in range(50):
        subprocess.run([LAB, "sweep"], check=True)
        mounts = Path("/proc/mounts").read_text()
        if not any(name in mounts for name in own_runs()):
            return
        time.sleep(0.1)
    raise AssertionError("mounts are left over")


STATUSES = [
    ("container", "exit 3", 3),
    ("container", "kill -KILL $$", 137),
    ("container", "kill -TERM $$", 143),
    ("vm", "kill -TERM $$", 143),
]
"""The shell that makes a status of a signal is the same everywhere, see service.py."""


@pytest.mark.parametrize(("env", "script", "status"), STATUSES, indirect=["env"])
def test_exit_status(env: dict[str, str], script: str, status: int) -> None:
    assert lab(env, "run", "--", "sh", "-c", script) == (status, b"", b"")


SEES = """
import json, os, sys
word, name = sys.argv[1:]
with open(name) as file:
    seen = {"word": word, "variable": os.environ["V"], "file": file.read()}
with open(name, "w") as file:
    file.write("changed")
with open("/out/seen", "w") as file:
    json.dump(seen, file)
print("e", file=sys.stderr)
sys.stdout.buffer.write(sys.stdin.buffer.read())
"""


def test_what_goes_in_and_comes_out(env: dict[str, str], tmp_path: Path) -> None:
    """Words, variables, files that git does not know, and separate streams, all unchanged."""
    untracked = LAB.with_name(f"untracked-{os.getpid()}")
    untracked.write_text("here")
    value = "a $HOME \"b\" 'c' %n\n${X} \\ é"
    given = bytes(range(256)) * 1000
    words = ["run", "--env", f"V={value}", "--", "python3", "-c", SEES, value]
    try:
        done = lab(
            {**env, "LAB_OUT": str(tmp_path)}, *words, f"tests/lab/{untracked.name}", given=given
        )
        assert done == (0, given, b"e\n")
        assert untracked.read_text() == "here", "nothing comes back but what is in /out"
    finally:
        untracked.unlink()
    seen = json.loads((tmp_path / "seen").read_text())
    assert seen == {"word": value, "variable": value, "file": "here"}


def _listen() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_ended_from_outside(env: dict[str, str], number: signal.Signals) -> None:
    """SIGINT by default: who runs the tests in the background of a shell hands it on ignored."""
    before = own_runs()
    command = [str(LAB), "run", "--", "sh", "-c", "echo up; sleep 1000"]
    with subprocess.Popen(
        command,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=_listen,
    ) as run:
        assert run.stdout and run.stdout.readline() == b"up\n"
        mine = own_runs() - before
        run.send_signal(number)
        status = run.wait(timeout=bound(20))
    assert status == (-9 if number is signal.SIGKILL else 128 + number)
    deadline = time.monotonic() + bound(20)
    while mine & own_runs() and time.monotonic() < deadline:
        time.sleep(0.1)
    # Others may have started one between the two looks; theirs end too, but not in our time.
    assert len(mine & own_runs()) < len(mine)


def test_random_numbers_differ(env: dict[str, str]) -> None:
    script = "cat /proc/sys/kernel/random/uuid; python3 -c 'import uuid; print(uuid.uuid4())'"
    first, second = (lab(env, "run", "--", "sh", "-c", script)[1].split() for _ in range(2))
    assert len({*first, *second}) == 4


@contextmanager
def other_machine() -> Iterator[None]:
    """One with a kernel in user mode, which uses the same image."""
    command = [str(LAB), "run", "--", "sh", "-c", "echo up; cat"]
    env, pipe = {**os.environ, "LAB": "vm"}, subprocess.PIPE
    with subprocess.Popen(command, env=env, stdin=pipe, stdout=pipe) as other:
        assert other.stdout and other.stdout.readline() == b"up\n"
        yield
        other.communicate(b"")


def test_the_emulator_takes_and_gives(tmp_path: Path) -> None:
    env = {**os.environ, "LAB": "emulator", "LAB_OUT": str(tmp_path)}
    script = "ls /src/pyproject.toml; cat; nproc > /out/processors; exit 3"
    with other_machine():
        assert lab(env, "run", "--", "sh", "-c", script, given=b"in") == (
            3,
            b"/src/pyproject.toml\nin",
            b"",
        )
    assert (tmp_path / "processors").read_text() == "2\n"
    assert_nothing_left()


@pytest.mark.parametrize("form", ["vm", "container"])
def test_reboot_between_commands(form: str) -> None:
    env = {**os.environ, "LAB": form}
    script = "cat /proc/sys/kernel/random/boot_id; ls /var/tmp/kept; touch /var/tmp/kept"
    one = ("sh", "-c", f"{script}; true")
    status, out, _ = lab(env, "run", "--", *one, "--reboot--", *one)
    lines = out.decode().splitlines()
    assert status == 0
    assert len(lines) == 3
    assert lines[0] != lines[1]
    assert lines[2] == "/var/tmp/kept"


def test_errors_are_one_line() -> None:
    status, out, err = lab({**os.environ, "LAB": "container"}, "run", "--cuts", "a")
    assert (status, out) == (125, b"")
    assert err == b"lab: cannot cut the power of a container (hint: LAB=vm)\n"

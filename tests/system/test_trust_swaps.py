"""Root plans a start while mallory swaps what it reads, as fast as renameat2(2) can.

Some rounds run in `make test`; more by hand: SWAP_ROUNDS=500 in the environment of the lab's run.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.plan import Plan, make_plan
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.unit import format_plan
from tests.system.cells import run, wait_for
from tests.system.homes import FLOW, Home

pytestmark = pytest.mark.lab

ROUNDS = int(os.environ.get("SWAP_ROUNDS") or 40)
SECRET = "known-to-root-alone"
SCOPE = Scope(False, 0)

SWAP = """
import ctypes, os, signal, sys
libc = ctypes.CDLL(None, use_errno=True)
one, other = (os.fsencode(word) for word in sys.argv[1:])
count, is_over = 0, []
signal.signal(signal.SIGTERM, lambda *_: is_over.append(1))
AT_FDCWD, RENAME_EXCHANGE = -100, 2
print("ready", flush=True)
while not is_over:
    if libc.renameat2(AT_FDCWD, one, AT_FDCWD, other, RENAME_EXCHANGE):
        sys.exit(os.strerror(ctypes.get_errno()))
    count += 1
print(count)
"""


@pytest.fixture
def mallory() -> Iterator[Home]:
    home = Home("mallory")
    home.write("dataflow.yml", FLOW)
    yield home
    for path in home.root.parent.glob("project*"):
        path.unlink() if path.is_symlink() else shutil.rmtree(path)


@pytest.fixture
def alices() -> Iterator[Home]:
    home = Home("alice")
    home.write("dataflow.yml", FLOW)
    yield home
    shutil.rmtree(home.root)


@contextmanager
def swapping(one: Path, other: Path) -> Iterator[None]:
    """Mallory exchanges the two all the time."""
    command = ["runuser", "-u", "mallory", "--", sys.executable, "-c", SWAP, str(one), str(other)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        assert child.stdout.readline() == "ready\n"
        try:
            yield
        finally:
            run("pkill", "-TERM", "--parent", str(child.pid))
            count = child.stdout.read()
    assert int(count) > ROUNDS


def plan(flow: Path) -> Plan:
    """What root would start."""
    return make_plan(SCOPE, StartRequest(str(flow), "swapped"))


def plans(one: Path, other: Path, flow: Path) -> list[Plan]:
    """What comes of all tries that are not refused while mallory swaps the two paths."""
    found = [plan(flow)]
    with swapping(one, other):
        for _ in range(ROUNDS):
            with suppress(DoraSystemdError):
                found.append(plan(flow))
    print(len(found) - 1, "of", ROUNDS, "planned")
    return found


def roots(path: Path, text: str) -> Path:
    """A file that root alone can read."""
    path.write_text(text)
    path.chmod(0o600)
    return path


def test_a_dataflow_lends_no_identity(mallory: Home, alices: Home) -> None:
    flow, link = mallory.root / "dataflow.yml", mallory.root / "link"
    link.symlink_to(alices.root / "dataflow.yml")
    found = plans(flow, link, flow)
    assert {one.user.pw_name for one in found if one.user} <= {"mallory"}
    assert all(one.user for one in found)


def test_a_directory_lends_no_identity(mallory: Home, alices: Home) -> None:
    link = mallory.root.with_name("project-link")
    link.symlink_to(alices.root)
    found = plans(mallory.root, link, mallory.root / "dataflow.yml")
    assert {one.user.pw_name for one in found if one.user} <= {"mallory"}


def test_settings_command_nothing_of_roots(mallory: Home) -> None:
    secret = roots(Path("/root/swapped"), SECRET)
    others = Path("/srv/swapped.systemd.yml")
    others.write_text(f"user: root\ncredentials: {{token: {secret}}}\n")
    own = mallory.write("dataflow.systemd.yml", "cpu_limit: 1\n")
    link = mallory.root / "link"
    link.symlink_to(others)
    try:
        found = plans(own, link, mallory.root / "dataflow.yml")
    finally:
        others.unlink()
    texts = {format_plan(one, lambda: Bus(SCOPE)) for one in found}
    assert not [text for text in texts if "User=mallory" not in text or str(secret) in text]


def test_an_environment_file_tells_nothing_of_roots(mallory: Home) -> None:
    secret = roots(Path("/root/swapped.env"), f"TOKEN={SECRET}\n")
    own, link = mallory.write("own.env", "TOKEN=own\n"), mallory.root / "link"
    link.symlink_to(secret)
    mallory.write("dataflow.systemd.yml", "env_file: own.env\n")
    found = plans(own, link, mallory.root / "dataflow.yml")
    assert {one.environment["TOKEN"] for one in found} <= {"own"}


def test_no_bind_mount_leads_elsewhere(mallory: Home) -> None:
    """Whatever PID 1 mounts as root has no component that mallory can replace."""
    place, link = mallory.root / "out", mallory.root / "link"
    place.mkdir()
    os.chown(place, mallory.uid, mallory.uid)
    home = Path("/home/bob")
    wait_for("bob's home", home.is_dir)
    link.symlink_to(home)
    mallory.write("dataflow.systemd.yml", "writable: [out]\n")
    found = plans(place, link, mallory.root / "dataflow.yml")
    texts = {format_plan(one, lambda: Bus(SCOPE)) for one in found}
    lines = {line for text in texts for line in text.splitlines()}
    binds = {line for line in lines if line.startswith(("BindPaths=", "BindReadOnlyPaths="))}
    assert not [line for line in binds if "/home/bob" in line or str(mallory.root) in line]

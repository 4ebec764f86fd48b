"""The bus adapter with the real pystemd: Debian's package, which unit tests do without."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.bus import systemd as bus
from dora_systemd.adapters.bus.library import dbuslib
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import scope_of
from tests.lab.pace import bound
from tests.system.cells import run
from tests.unit.fakes.manager import ScopeIn


@given(st.from_regex(r"[A-Za-z0-9._-]+", fullmatch=True))
def test_object_paths_are_those_of_sd_bus(name: str) -> None:
    expected = dbuslib.path_encode(b"/org/freedesktop/systemd1/unit", f"x{name}".encode())
    assert bus._unit_path(f"x{name}") == expected


def test_no_manager(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        bus.Bus(ScopeIn(is_user=True, uid=1000, root=tmp_path))
    assert caught.value.code is ExitCode.NO_SYSTEMD
    assert caught.value.message.startswith("cannot reach the systemd of this user")
    assert caught.value.hint


def test_pystemd_is_loaded_without_lxml_and_stays_usable() -> None:
    script = (
        "import sys; from dora_systemd.adapters.bus.library import dbuslib\n"
        "assert 'lxml' not in sys.modules and 'pystemd' not in sys.modules\n"
        "import pystemd; from pystemd.dbuslib import DBus\n"
        "assert pystemd.SDUnit and DBus is dbuslib.DBus\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_threads_load_pystemd_at_the_same_time() -> None:
    """As requests do that reach a gateway which has just been started."""
    script = (
        "import sys, threading\n"
        "from dora_systemd.adapters.bus import systemd as bus\n"
        "from dora_systemd.scope import scope_of\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "sys.setswitchinterval(1e-6)\n"
        "barrier = threading.Barrier(8)\n"
        "ask = lambda _: (barrier.wait(), bus.Bus(scope_of(None)).version())[1]\n"
        "with ThreadPoolExecutor(8) as pool: print(len(set(pool.map(ask, range(8)))))\n"
    )
    for _ in range(5):
        assert run(sys.executable, "-c", script).stdout == "1\n"


def test_a_connection_ends_with_its_object() -> None:
    """The gateway opens one for each reading."""
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        bus.Bus(scope_of(None)).version()
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.mark.lab
def test_a_message_bus_that_does_not_answer() -> None:
    """Root reads without it; the rest is told in time."""
    unit = "dbus.service"
    run("systemctl", "kill", "--signal=STOP", unit)
    try:
        begin = time.monotonic()
        assert run("doractl", "list").stdout == "No dataflow is running.\n"
        assert time.monotonic() - begin < bound(3)
        for switch, verb in (("root", "restart"), ("alice", "list")):
            begin = time.monotonic()
            done = run("runuser", "-u", switch, "--", "doractl", "--system", verb, "x", check=False)
            assert time.monotonic() - begin < bound(8)
            assert done.returncode == ExitCode.NO_SYSTEMD
            assert done.stderr.startswith(
                "doractl: cannot reach systemd: the message bus does not answer\n"
            )
    finally:
        run("systemctl", "kill", "--signal=CONT", unit)
    assert bus.Bus(scope_of(None)).version()

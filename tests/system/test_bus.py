"""The bus adapter with the real pystemd: Debian's package, which unit tests do without."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd import bus
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import scope_of
from tests.unit.fake_manager import ScopeIn


@given(st.from_regex(r"[A-Za-z0-9._-]+", fullmatch=True))
def test_object_paths_are_those_of_sd_bus(name: str) -> None:
    library: Any = bus._dbuslib()
    expected = library.path_encode(b"/org/freedesktop/systemd1/unit", f"x{name}".encode())
    assert bus._unit_path(f"x{name}") == expected


def test_no_manager(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        bus.Bus(ScopeIn(is_user=True, uid=1000, root=tmp_path))
    assert caught.value.code is ExitCode.NO_SYSTEMD
    assert caught.value.message.startswith("cannot reach the systemd of this user")
    assert caught.value.hint


def test_pystemd_is_loaded_without_lxml_and_stays_usable() -> None:
    script = (
        "import sys; from dora_systemd import bus; bus._dbuslib()\n"
        "assert 'lxml' not in sys.modules and 'pystemd' not in sys.modules\n"
        "import pystemd; from pystemd.dbuslib import DBus\n"
        "assert pystemd.SDUnit and DBus is bus._dbuslib().DBus\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_a_connection_ends_with_its_object() -> None:
    """The gateway opens one for each reading."""
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        bus.Bus(scope_of(None)).version()
    assert len(list(Path("/proc/self/fd").iterdir())) == before

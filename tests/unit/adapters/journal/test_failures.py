"""Which dataflows have failed after the last that our code recorded."""

from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.journal.failures import later_failures
from dora_systemd.adapters.journal.reader import LastEvent
from tests.unit.fakes.library import fake_journalctl
from tests.unit.fakes.manager import UUID

OTHER = UUID[:-1] + "1"
STOPPED = LastEvent("robot", UUID, "dataflow-stopped", 20, "", "s=aa;i=1f;b=bb")


def record(at_us: int, cursor: str = "", uuid: str = UUID, **more: Any) -> dict[str, Any]:
    """One of systemd."""
    own = {"DORA_DATAFLOW": uuid, "UNIT": "dora-robot.service"}
    return {**own, "__REALTIME_TIMESTAMP": str(at_us), "__CURSOR": cursor, **more}


@pytest.mark.parametrize(
    "found, expected",
    [
        ([record(30), record(25)], {UUID: 30}),
        ([record(10)], {}),
        ([record(30, uuid=OTHER)], {}),
        ([record(30, UNIT="other.service")], {}),
        ([record(30, DORA_DATAFLOW=[UUID, OTHER])], {}),
        pytest.param([record(30, "s=aa;i=1e;b=bb")], {}, id="the clock was set back"),
        pytest.param([record(10, "s=aa;i=20;b=bb")], {UUID: 10}, id="the clock was set forward"),
        pytest.param([record(30, "s=cc;i=1;b=bb")], {UUID: 30}, id="another journald"),
    ],
)
def test_failures(
    found: list[dict[str, Any]],
    expected: dict[str, int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = fake_journalctl(monkeypatch, tmp_path, found)
    assert later_failures([STOPPED]) == expected
    (asked,) = calls.read_text().splitlines()
    failed = "MESSAGE_ID=d9b373ed55a64feb8242e02dbe79a49c"
    assert asked.endswith(f" -- _PID=1 {failed} DORA_DATAFLOW={UUID}")

"""What the page is told of one dataflow, and of those that have ended, from a journal of ours."""

import asyncio
import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.gateway.page_messages import MAX_ITEMS, MAX_TEXT, PageMessage
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.live.about import (
    read_about,
    read_ended,
    read_own_bundles,
    read_own_releases,
    read_waits,
)
from dora_systemd.gateway.live.lines import find_lines
from dora_systemd.gateway.live.past import SPAN, read_timeline
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.listing import store_of
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.library import fake_journalctl, fake_systemd
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options
from tests.unit.fakes.programs import make_program

GONE = "11111111-2222-4333-8444-555555555555"


def event(name: str, at: int, dataflow: str = "robot", uuid: str = UUID, **more: Any) -> bytes:
    own = {f"DORA_{key.upper()}": value for key, value in more.items()}
    record = {
        "__REALTIME_TIMESTAMP": str(at),
        "_SYSTEMD_INVOCATION_ID": "1",
        "_SYSTEMD_UNIT": f"dora-{dataflow}.service",
        "DORA_DATAFLOW_NAME": dataflow,
        "DORA_DATAFLOW": uuid,
        "DORA_EVENT": name,
        **own,
    }
    return json.dumps(record).encode() + b"\n"


CRASH = (
    event("dataflow-failed", 40, cause="node-failed", reason="node a: exit code 3", nodes="a"),
    event("node-crashed", 30, node="a", exit="exit code 3"),
    event("node-ready", 20, node="a"),
    event("dataflow-starting", 10),
)


class Bench:
    """A scope with the dataflow robot. journal: what journalctl prints, newest first."""

    def __init__(self, root: Path, patch: pytest.MonkeyPatch) -> None:
        self.root, self.patch = root, patch
        self.manager = FakeManager()
        self.manager.add(options(), active="failed", StatusText="failed: node a: exit code 3")
        self.scope: Scope = ScopeIn(is_user=False, uid=os.getuid(), root=root)
        fake_systemd(patch, self.manager)
        self.records = FakeJournal(patch, root)

    def journal(self, *records: bytes) -> Path:
        return fake_journalctl(self.patch, self.root, b"".join(records))


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


def test_a_failed_one_with_its_reason_and_its_nodes(bench: Bench) -> None:
    bench.journal(*CRASH)
    found = read_about(bench.scope, UUID)
    assert found["why"]["summary"] == "node a: exit code 3"
    assert found["why"]["node"] == "a"
    assert "doractl restart robot" in found["why"]["remedies"][0]
    row = found["row"]
    assert (row["status"], row["restarts"], row["nodes_total"]) == ("Failed", 0, 1)
    (node,) = row["nodes"]
    assert (node["node"], node["state"], node["exit"]) == ("a", "failed", "exit code 3")
    assert (row["started_us"], row["ended_us"], found["why"]["at_us"]) == (10, 40, 30)
    assert found["facts"]["hot_reload"] is False
    json.dumps(found)


def test_texts_of_others_are_shown_and_bounded(bench: Bench) -> None:
    reason = "\x1b]0;title\x07" + "x" * MAX_TEXT + "yyy\x07"
    bench.journal(event("dataflow-failed", 40, reason=reason), *CRASH[1:])
    text = json.dumps(read_about(bench.scope, UUID))
    assert "\\u001b" not in text
    assert "\\u0007" not in text
    assert "yyy" not in text


def test_without_a_journal_the_settings_are_there(bench: Bench) -> None:
    (bench.records.directory / "system.journal").unlink()
    found = read_about(bench.scope, UUID)
    assert found["problem"] == "cannot find a journal on this machine"
    assert found["why"] is None
    assert found["row"]["name"] == "robot"
    assert found["facts"]["sandbox"] == "none"


def test_what_nobody_knows(bench: Bench) -> None:
    bench.journal()
    with pytest.raises(DoraSystemdError, match="no dataflow named") as caught:
        read_about(bench.scope, GONE)
    assert caught.value.code is ExitCode.NOT_FOUND


def test_the_ended_ones_by_name(bench: Bench) -> None:
    older = "22222222-2222-4333-8444-555555555555"
    bench.journal(
        event("dataflow-stopped", 90, "arm", GONE),
        event("dataflow-stopped", 80, "arm", older),
        event("dataflow-stopped", 70, "robot", older),
    )
    (row,) = read_ended(bench.scope)["dataflows"]
    assert (row["name"], row["uuid"], row["status"]) == ("arm", GONE, "Stopped")
    found = read_about(bench.scope, GONE)
    assert found["row"]["name"] == "arm"
    assert found["facts"] == {}


def line(at: int, text: str) -> bytes:
    return f"__REALTIME_TIMESTAMP={at}\nMESSAGE={text}\nDORA_NODE=a\n\n".encode()


def search(bench: Bench, most: int = 10, **more: Any) -> tuple[list[str], bool]:
    message = PageMessage("find", UUID, **more)
    lines, is_whole = asyncio.run(find_lines(bench.scope, message, most))
    return [one["text"] for one in lines], is_whole


def test_a_search_gives_the_newest_lines_oldest_first(bench: Bench) -> None:
    bench.journal(line(3, "three"), line(2, "two"), line(1, "one"))
    assert search(bench) == (["one", "two", "three"], True)
    assert search(bench, 3) == (["one", "two", "three"], True)
    assert search(bench, 2) == (["two", "three"], False)


def test_what_a_search_asks_journalctl(bench: Bench) -> None:
    calls = bench.journal()
    search(bench, node="a", search="a (b)*", since="10m", until="@5")
    (call,) = calls.read_text().splitlines()
    assert r"--grep=a\ \(b\)\*" in call
    assert {"--since=-10m", "--until=@5", "--reverse", "DORA_NODE=a"} <= set(call.split())
    assert "--follow" not in call


def test_the_run_before(bench: Bench) -> None:
    calls = bench.journal(
        event("dataflow-starting", 9).replace(b'"1"', b'"two"'),
        event("dataflow-starting", 5).replace(b'"1"', b'"one"'),
    )
    search(bench, run="PREVIOUS")
    assert "_SYSTEMD_INVOCATION_ID=one" in calls.read_text().splitlines()[-1]


def test_the_logs_of_an_ended_one_are_its_own(bench: Bench) -> None:
    calls = bench.journal(event("dataflow-stopped", 90, "arm", GONE))
    message = PageMessage("find", GONE)
    asyncio.run(find_lines(bench.scope, message, 5))
    last = calls.read_text().splitlines()[-1].split()
    assert {"_SYSTEMD_UNIT=dora-arm.service", f"DORA_DATAFLOW={GONE}"} <= set(last)


def test_a_time_that_journalctl_does_not_take(bench: Bench, tmp_path: Path) -> None:
    bench.journal()
    make_program(tmp_path / "journalctl", 'echo "Failed to parse timestamp: x" >&2\nexit 1')
    with pytest.raises(DoraSystemdError, match="cannot read the time") as caught:
        search(bench, since="x")
    assert caught.value.code is ExitCode.USAGE


def test_the_releases_of_a_dataflow(bench: Bench) -> None:
    bench.journal()
    bench.scope = ScopeIn(is_user=False, uid=os.getuid(), root=bench.root / "x\x1b[2J")
    for number in range(1, MAX_ITEMS + 50):
        store_of(bench.scope, "robot").tree(f"2026{number:04}T220012").mkdir(parents=True)
    found = read_own_releases(bench.scope, UUID)["releases"]
    assert (len(found), found[0]["release"]) == (MAX_ITEMS, f"2026{MAX_ITEMS + 49:04}T220012")
    assert found[0]["tree"].startswith(f"{bench.root}/x/state/")


def test_the_timeline_of_a_dataflow(bench: Bench) -> None:
    now = time.time_ns() // 1000
    records = [
        event("node-crashed", now - 5, node="a", exit="exit code 3"),
        event("dataflow-starting", now - 9),
        event("node-crashed", now - SPAN - 10**6, node="a"),
    ]
    hostile = json.loads(records[0]) | {"MESSAGE": "Node \x1b[31ma\x1b[0m crashed\x07 <b>"}
    calls = bench.journal(json.dumps(hostile).encode() + b"\n", *records[1:])
    found = read_timeline(bench.scope, UUID)
    (life,) = found["lives"]
    assert (life["began_us"], life["status"]) == (now - 9, "Failed")
    (mark,) = found["marks"]
    assert (mark["kind"], mark["text"]) == ("failure", r"Node a crashed\x07 <b>")
    assert found["now_us"] - found["since_us"] == SPAN
    asked = calls.read_text().split()
    assert {"DORA_EVENT=node-crashed", f"DORA_DATAFLOW={UUID}"} <= set(asked)
    assert any(one.startswith("--output-fields=MESSAGE,") for one in asked)


def test_the_timeline_of_one_that_has_ended(bench: Bench) -> None:
    now = time.time_ns() // 1000
    bench.journal(
        event("dataflow-stopped", now - 1, "arm", GONE),
        event("dataflow-starting", now - 9, "arm", GONE),
    )
    (life,) = read_timeline(bench.scope, GONE)["lives"]
    assert (life["ended_us"], life["status"]) == (now - 1, "Stopped")


def test_what_a_dataflow_has_used_since_its_start(bench: Bench) -> None:
    group = fake_cgroups(bench.patch, bench.root) / "x"
    group.mkdir()
    (group / "cpu.stat").write_text("usage_usec 5000000\n")
    (group / "memory.peak").write_text("4096\n")
    bench.manager.add(options(), ControlGroup="/x")
    bench.journal(event("dataflow-starting", time.time_ns() // 1000 - 10_000_000))
    (life,) = read_timeline(bench.scope, UUID)["lives"]
    assert (life["ended_us"], life["memory_peak_bytes"]) == (None, 4096)
    assert 40 < life["cpu_average_percent"] <= 50
    bench.manager.add(options(), ControlGroup="")
    (life,) = read_timeline(bench.scope, UUID)["lives"]
    assert (life["cpu_average_percent"], life["memory_peak_bytes"]) == (None, None)


def test_the_bundles_of_a_dataflow(bench: Bench) -> None:
    bench.journal()
    place = bench.scope.state_root / "dora-systemd/bundles/robot"
    place.mkdir(parents=True)
    (place / "robot-20261127T041500Z-requested.tar").write_bytes(b"cut")
    (found,) = read_own_bundles(bench.scope, UUID)["bundles"]
    assert (found["bundle"], found["size_bytes"]) == ("robot-20261127T041500Z-requested.tar", 3)
    assert (found["event"], found["summary"]) == ("requested", None)


def test_nobody_waits_in_what_is_down(bench: Bench) -> None:
    assert read_waits(bench.scope, UUID) == {"waits": [], "remedies": []}

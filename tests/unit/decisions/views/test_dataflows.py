"""Words and whole tables of `doractl list`."""

import re
from random import Random
from uuid import UUID

import pytest

from dora_systemd.decisions.views.dataflows import format_dataflows, shortest_prefixes, status_word
from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.formats import format_uptime, local_time
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.values import SECOND

A = "550e8400-e29b-41d4-a716-446655440000"
B = "550e8401-e29b-41d4-a716-446655440000"
C = "550e8400-e29b-51d4-a716-446655440000"


@pytest.mark.parametrize(
    ("active", "sub", "stage", "word"),
    [
        ("activating", "start", "waiting", "Starting"),
        ("activating", "auto-restart", "", "Restarting"),
        ("activating", "auto-restart-queued", "", "Restarting"),
        ("active", "running", "running", "Running"),
        ("active", "running", "", "Running"),
        ("active", "running", "degraded", "Degraded"),
        ("active", "running", "stopping", "Stopping"),
        ("reloading", "reload", "running", "Running"),
        ("deactivating", "stop-sigterm", "running", "Stopping"),
        ("failed", "failed", "degraded", "Failed"),
        ("inactive", "dead", "", "Stopped"),
        ("something-new", "x", "", "Stopped"),
    ],
)
def test_status_word(active: str, sub: str, stage: str, word: str) -> None:
    assert status_word(active, sub, stage) == word


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "00:00:00"),
        (332, "00:05:32"),
        (86399, "23:59:59"),
        (86400, "1d 00:00:00"),
        (93784, "1d 02:03:04"),
    ],
)
def test_uptime(seconds: int, text: str) -> None:
    assert format_uptime(seconds * SECOND) == text


def test_unknown_uptime() -> None:
    assert format_uptime(None) == "-"


def test_prefixes_are_short_and_unambiguous() -> None:
    assert shortest_prefixes([A, B, C]) == {A: A[:15], B: B[:8], C: C[:15]}


def test_prefix_of_one() -> None:
    assert shortest_prefixes([A]) == {A: "550e8400"}


def test_prefixes_of_many_mean_one_each() -> None:
    dice = Random(7)
    uuids = [str(UUID(int=dice.getrandbits(70) << 58)) for _ in range(300)]
    uuids += [one[:-1] + "f" for one in uuids[:100]]
    found = shortest_prefixes(uuids)
    assert found.keys() == set(uuids)
    for uuid, prefix in found.items():
        assert [one for one in found if one.startswith(prefix)] == [uuid]
        longer = len(prefix) > 8
        assert not longer or sum(one.startswith(prefix[:-1]) for one in found) > 1
    assert shortest_prefixes([A, A]) == {A: "550e8400"}
    assert shortest_prefixes([]) == {}


ROWS = (
    DataflowRow(
        uuid=A,
        name="robot",
        unit="dora-robot.service",
        status="Running",
        dataflow="/srv/robot.yml",
        text="2/2 nodes running",
        uptime=332 * SECOND,
        nodes_alive=2,
        nodes_total=2,
        cpu_percent=12.46,
        memory=256 * 1024**2,
        restarts=0,
        nodes=(
            NodeRow("camera", "running", 42, 5.0, 128 * 1024**2, 200 * 1024**2, 0),
            NodeRow("detector", "failed", 0, restarts=3, exit="exit code 1"),
        ),
        enabled=True,
    ),
    DataflowRow(uuid=B, name="a-longer-name", unit="u", status="Failed", restarts=12),
)


def test_table_of_dataflows() -> None:
    rows = [ROWS[0], ROWS[1]._replace(status="Restarting")]
    assert format_dataflows(rows) == (
        "UUID      NAME           STATUS        UPTIME  NODES  CPU%   MEM  RESTARTS  BOOT\n"
        "550e8400  robot          Running     00:05:32  2/2    12.5  256M         0  yes\n"
        "550e8401  a-longer-name  Restarting         -  -         -     -        12  -"
    )


ENDED = ROWS[1]._replace(
    ended=1_790_000_000_000_000, text="node detector: exit code 1, node plot: x"
)


def test_what_a_stop_waits_for() -> None:
    camera, detector = ROWS[0].nodes
    nodes = (camera._replace(text="writing episode 12", stop_left=41_400_000), detector)
    stopping = ROWS[0]._replace(status="Stopping", nodes=nodes)
    words = "camera: writing episode 12, 41 s left"
    assert f"\nStatus:   Stopping ({words})\n" in format_dataflow(stopping)
    header, line = format_dataflows([stopping]).splitlines()
    assert header.split()[-1] == "WHY"
    assert line.endswith(words)
    quiet = stopping._replace(nodes=(nodes[0]._replace(text=""), detector))
    assert "Stopping (camera, 41 s left)" in format_dataflow(quiet)
    usual = stopping._replace(nodes=(camera, detector))
    assert "WHY" not in format_dataflows([usual])
    assert "Stopping (2/2 nodes running)" in format_dataflow(usual)


@pytest.mark.parametrize(
    ("status", "text", "words"),
    [
        ("Stopping", "stopping", "Stopping"),
        ("Stopping", "stopping, waiting for a", "Stopping (waiting for a)"),
        ("Waiting", "waiting for machine b (off)", "Waiting (for machine b (off))"),
        ("Failed", "failed to start", "Failed (failed to start)"),
    ],
)
def test_no_status_is_said_twice(status: str, text: str, words: str) -> None:
    row = ROWS[1]._replace(status=status, text=text)
    assert f"\nStatus:   {words}\n" in format_dataflow(row)


def test_table_with_what_has_ended() -> None:
    rows = [ROWS[0], ENDED, ROWS[1]._replace(uuid=C, status="Stopped")]
    header, up, failed, stopped = format_dataflows(rows).splitlines()
    assert header.split()[-3:] == ["BOOT", "ENDED", "WHY"]
    assert up.split()[-3:] == ["yes", "-", "-"]
    moment = local_time(ENDED.ended)
    assert failed.endswith(f"        12  -     {moment}  node detector: exit code 1, node plot: x")
    assert stopped.split()[-2:] == ["-", "-"]
    for width in (60, 80, 100, 120):
        lines = format_dataflows(rows, width).splitlines()
        assert max(map(len, lines)) <= width
        assert moment in lines[2]
        assert lines[2].endswith("…")
    assert format_dataflows(rows, 60).split()[:4] == ["NAME", "STATUS", "ENDED", "WHY"]


@pytest.mark.parametrize(
    ("status", "color"),
    [
        *(("Failed", 31), ("Degraded", 33), ("Starting", 33), ("Restarting", 33)),
        *(("Running", 0), ("Stopped", 0), ("Finished", 0)),
    ],
)
def test_colors_of_the_table(status: str, color: int) -> None:
    row = ROWS[0]._replace(name=status, status=status)
    plain = format_dataflows([row], 100).splitlines()
    header, line = format_dataflows([row], 100, want_colors=True).splitlines()
    assert header == f"\x1b[4m{plain[0]}\x1b[0m"
    painted = f"\x1b[{color}m{status}\x1b[0m" if color else status
    assert line.split()[1:3] == [status, painted]
    assert line.replace(painted, status) == plain[1]
    shown = format_dataflow(row, 100, want_colors=True)
    assert f"Name:     {status}\n" in shown
    assert f"Status:   {painted} (2/2 nodes" in shown
    assert "\x1b[31mFailed\x1b[0m     -" in shown  # the state of a node


def test_no_text_controls_the_terminal() -> None:
    row = ENDED._replace(text="\x1b]0;x\a\nnode", dataflow="/srv/\x1b[2J.yml")
    for shown in (format_dataflows([row]), format_dataflow(row), format_dataflow(row, 60)):
        assert "\x1b" not in shown
        assert "\\x1b" in shown
    assert len(format_dataflows([row]).splitlines()) == 2


@pytest.mark.parametrize("width", [60, 80])
def test_one_dataflow_on_a_narrow_terminal(width: int) -> None:
    node = LIMITED.nodes[1]._replace(node="n" * 30, exit="out of memory, peak 300M, limit 300M")
    row = LIMITED._replace(dataflow=f"/{'d' * 90}/flow.yml", nodes=(LIMITED.nodes[0], node))
    shown = format_dataflow(row, width).splitlines()
    assert max(map(len, shown)) <= width
    assert shown[3].endswith("…")
    assert shown[-3].split()[:2] == ["NODE", "STATE"]
    assert shown[-3].split()[-1] == "EXIT"


@pytest.mark.parametrize("width", [60, 80, 120])
def test_what_nodes_say_of_themselves(width: int) -> None:
    camera = ROWS[0].nodes[0]._replace(text="t" * 200, watchdog=5 * SECOND, sign_age=1_200_000)
    row = ROWS[0]._replace(nodes=(camera, ROWS[0].nodes[1]))
    *_, title, shown, other = format_dataflow(row, width).splitlines()
    assert max(map(len, (title, shown))) <= width
    assert title.endswith("STATUS TEXT")
    assert shown.endswith("tt…")
    assert not other.endswith("t")
    assert ("1.2s/5s" in shown) == (width > 60)
    object_ = dataflow_object(row)["nodes"][0]
    assert (object_["watchdog_us"], object_["watchdog_age_us"]) == (5_000_000, 1_200_000)
    assert object_["text"] == "t" * 200
    assert dataflow_object(row)["nodes"][1]["text"] is None


def test_a_long_name_leaves_room_for_the_reason() -> None:
    long = ENDED._replace(name="x" * 150, text="node detector: exit code 1")
    text = format_dataflows([ROWS[0], long], 80)
    assert max(map(len, text.split("\n"))) <= 80
    assert "node detector: exit" in text


def test_a_narrow_terminal() -> None:
    long = ROWS[0]._replace(uuid=C, name="a-very-long-name-of-a-dataflow-that-fits-nowhere")
    rows = [ROWS[0], ROWS[1]._replace(status="Restarting"), long]
    whole = format_dataflows(rows)
    assert format_dataflows(rows, 200) == whole
    for width in (60, 70, 80, 100):
        lines = format_dataflows(rows, width).splitlines()
        assert max(map(len, lines)) <= width
        assert lines[1].split()[1:3] == ["robot", "Running"]
        assert lines[3].split()[1].startswith("a-very-long")
        assert lines[3].split()[1].endswith("…")
    assert format_dataflows(rows, 80).splitlines()[0].split()[-1] == "RESTARTS"
    assert format_dataflows(rows, 60).splitlines()[0].split() == (
        ["UUID", "NAME", "STATUS", "NODES", "CPU%", "MEM"]
    )
    assert max(map(len, format_dataflows(rows, 10).splitlines())) < 40


def test_json_has_null_for_unknown_times() -> None:
    values = dataflow_object(ROWS[1])
    assert (values["started_us"], values["ended_us"]) == (None, None)
    assert dataflow_object(ROWS[0]._replace(started=5))["started_us"] == 5


def test_one_dataflow() -> None:
    assert format_dataflow(ROWS[0]) == (
        f"Dataflow: {A}\n"
        "Name:     robot\n"
        "Unit:     dora-robot.service\n"
        "File:     /srv/robot.yml\n"
        "Status:   Running (2/2 nodes running)\n"
        "Uptime:   00:05:32\n"
        "Ready:    -\n"
        "CPU:      12.5%\n"
        "Memory:   256M\n"
        "Restarts: 0 of the dataflow by systemd, 3 of single nodes by dora\n"
        "At boot:  started\n"
        "\n"
        "NODE      STATE    PID  CPU%   MEM  PEAK  RESTARTS  EXIT\n"
        "camera    Running   42   5.0  128M  200M         0  -\n"
        "detector  Failed     -     -     -     -         3  exit code 1"
    )


def test_times_have_names() -> None:
    shown = format_dataflow(ROWS[0]._replace(started=1, ready=2 * SECOND))
    assert re.search(r"Started: +1970-01-01 \S+ \S+\nReady: +1970-01-01 ", shown)
    values = dataflow_object(ROWS[0]._replace(started=1, ready=2))
    assert (values["started_us"], values["ready_us"], values["ended_us"]) == (1, 2, None)


def test_the_table_says_why_one_is_degraded() -> None:
    rows = (ROWS[0]._replace(status="Degraded"), ROWS[0])
    header, line, other = format_dataflows(rows).splitlines()
    assert header.endswith("WHY")
    assert line.endswith("node detector: exit code 1")
    assert other.endswith("-")


def test_the_reason_stands_behind_the_status() -> None:
    row = ROWS[0]._replace(status="Failed", text="node a: exit code 1", nodes=())
    assert "Status:   Failed (node a: exit code 1)\n" in format_dataflow(row)


LIMITED = ROWS[0]._replace(
    memory_limit=4 << 30,
    memory_peak=300 << 20,
    cpu_limit=200.0,
    throttled=12.0,
    nodes=(
        ROWS[0].nodes[0]._replace(memory_limit=1 << 30, cpu_limit=150.0, throttled=31.25),
        ROWS[0].nodes[1],
    ),
)


def test_limits_stand_beside_what_is_used() -> None:
    assert format_dataflows([LIMITED]).splitlines()[1].split()[6:] == ["256M/4G", "0", "yes"]
    assert format_dataflows([LIMITED]).splitlines()[1].split()[5] == "12.5/200"
    lines = format_dataflow(LIMITED).splitlines()
    assert "CPU:      12.5% of 200%, throttled 12.0% of the time" in lines
    assert "Memory:   256M of 4G (peak 300M)" in lines
    assert lines[-3:] == [
        "NODE      STATE    PID     CPU%  THROTTLED%      MEM  PEAK  RESTARTS  EXIT",
        "camera    Running   42  5.0/150        31.2  128M/1G  200M         0  -",
        "detector  Failed     -        -           -        -     -         3  exit code 1",
    ]
    values = dataflow_object(LIMITED)
    assert (values["memory_limit_bytes"], values["cpu_limit_percent"]) == (4 << 30, 200.0)
    assert values["nodes"][0]["throttled_percent"] == 31.25
    assert values["nodes"][1]["memory_limit_bytes"] is None


def test_one_dataflow_without_nodes() -> None:
    text = format_dataflow(ROWS[1])
    assert text.endswith(
        "Restarts: 12 of the dataflow by systemd\nReason:   doractl why a-longer-name"
    )


def test_json_has_units_in_its_keys() -> None:
    values = dataflow_object(ROWS[0])
    assert values["uuid"] == A
    assert values["uptime_us"] == 332 * SECOND
    assert values["memory_bytes"] == 256 * 1024**2
    assert values["memory_peak_bytes"] is None
    assert values["nodes"][0]["memory_peak_bytes"] == 200 * 1024**2
    assert values["nodes"][1]["cpu_percent"] is None

"""Which nodes have a watchdog: of options, files and the runner's command line."""

import pytest

from dora_systemd.decisions.cell.launch import watchdogs_of
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.settings.resolve import resolve_settings, with_settings
from dora_systemd.decisions.watchdog.watchdogs import (
    ALL_NODES,
    OFF,
    check_watchdogs,
    parse_watchdog,
    watchdog_of,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND, format_duration
from tests.unit.fakes.manager import options as runner_options
from tests.unit.fakes.manager import with_texts

OPTIONS = runner_options()


MACHINES = OPTIONS._replace(placed=(Placed("yolo", "gpu"),))


def given(document: object, options: RunnerOptions = OPTIONS, *nodes: str) -> list[str]:
    settings = resolve_settings({"nodes": nodes}, {}, [("/srv/robot.systemd.yml", document)])
    found = watchdogs_of(with_settings(options, settings)).items()
    return [f"{node}={format_duration(time)}".removeprefix("=") for node, time in found]


@pytest.mark.parametrize("text", ["5", "0", "-1s", "199ms", "0.1s", "soon", "", "5 gigs", "1 5"])
def test_bad_times(text: str) -> None:
    with pytest.raises(DoraSystemdError, match="cannot use") as caught:
        parse_watchdog(text)
    assert caught.value.code is ExitCode.USAGE
    assert "200ms" in caught.value.hint


def test_who_has_one() -> None:
    assert given(None) == []
    assert given({"nodes": {"cam": {"watchdog": "5s"}}}) == ["cam=5s"]
    assert given({"notify": True}) == ["infinity"]
    assert given({"nodes": {"cam": {"notify": True}}}) == ["cam=infinity"]
    assert given({"watchdog": "5s", "nodes": {"cam": {"notify": True}}}) == ["5s"]
    assert given({"watchdog": "5s", "nodes": {"cam": {"watchdog": "infinity"}}}) == ["5s", "cam=0"]
    both = {"watchdog": "infinity", "notify": True}
    assert given({"watchdog": "5s", "nodes": {"cam": both}}) == ["5s", "cam=infinity"]
    of_file = {"nodes": {"cam": {"watchdog": "5s"}}}
    assert given(of_file, OPTIONS, "cam:watchdog=2s") == ["cam=2s"]
    assert given({"notify": True, "nodes": {"cam": {"notify": False}}}) == ["infinity", "cam=0"]


def test_a_node_with_a_time_to_stop_can_extend_it() -> None:
    assert given({"nodes": {"cam": {"stop": "60s"}, "arm": {"stop": {"after": "cam"}}}}) == [
        "cam=infinity"
    ]


def test_nodes_of_other_machines_have_none_here() -> None:
    of_all = with_texts(MACHINES, "watchdog=5s")
    assert watchdogs_of(of_all) == {ALL_NODES: 5 * SECOND, "yolo": OFF}
    assert watchdogs_of(of_all._replace(machine="gpu")) == {ALL_NODES: 5 * SECOND}
    assert watchdogs_of(with_texts(MACHINES, "cam:watchdog=5s")) == {"cam": 5 * SECOND}


def test_the_time_of_one_node() -> None:
    assert watchdog_of({"cam": SECOND}, "lidar") == OFF
    assert watchdog_of({ALL_NODES: SECOND, "cam": OFF}, "cam") == OFF
    assert watchdog_of({ALL_NODES: SECOND, "cam": INFINITY}, "lidar") == SECOND


def test_nodes_that_cannot_have_one() -> None:
    check_watchdogs({ALL_NODES: SECOND, "cam": SECOND, "op": OFF}, ["cam"])
    with pytest.raises(DoraSystemdError, match="give the node op a notify socket: dora itself"):
        check_watchdogs({"op": INFINITY}, ["cam", "lidar"])

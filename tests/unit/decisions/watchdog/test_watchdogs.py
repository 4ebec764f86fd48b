"""Which nodes have a watchdog: of options, files and the runner's command line."""

import pytest

from dora_systemd.decisions.settings.resolve import resolve_settings, watchdogs
from dora_systemd.decisions.watchdog.watchdogs import (
    ALL_NODES,
    OFF,
    check_watchdogs,
    format_watchdogs,
    parse_sockets,
    parse_watchdog,
    watchdog_of,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND


def given(document: object, **flags: object) -> list[str]:
    settings = resolve_settings(flags, {}, [("/srv/robot.systemd.yml", document)])
    found = watchdogs(settings)
    texts = format_watchdogs(found)
    assert parse_sockets(texts) == found
    return texts


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
    assert given({"nodes": {"cam": {"watchdog": "5s"}}}, watchdog=["cam=2s"]) == ["cam=2s"]
    assert given({"notify": True, "nodes": {"cam": {"notify": False}}}) == ["infinity", "cam=0"]


def test_a_node_names_no_other() -> None:
    with pytest.raises(DoraSystemdError, match="'lidar=5s' as watchdog of node cam"):
        given({"nodes": {"cam": {"watchdog": "lidar=5s"}}})


def test_the_time_of_one_node() -> None:
    assert watchdog_of({"cam": SECOND}, "lidar") == OFF
    assert watchdog_of({ALL_NODES: SECOND, "cam": OFF}, "cam") == OFF
    assert watchdog_of({ALL_NODES: SECOND, "cam": INFINITY}, "lidar") == SECOND


def test_nodes_that_cannot_have_one() -> None:
    nodes = ["cam", "lidar", "op"]
    check_watchdogs({ALL_NODES: SECOND, "cam": SECOND, "op": OFF}, nodes, ["cam"])
    with pytest.raises(DoraSystemdError, match="cannot watch the node 'can'") as caught:
        check_watchdogs({"can": SECOND}, nodes, nodes)
    assert caught.value.hint == "did you mean cam?"
    with pytest.raises(DoraSystemdError, match="node op: dora itself starts it"):
        check_watchdogs({"op": INFINITY}, nodes, ["cam", "lidar"])

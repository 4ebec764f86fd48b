"""The setting `stop`: what it may be, and how long the stop of a dataflow takes with it."""

import pytest

from dora_systemd.decisions.cell.stops import (
    NodeStop,
    check_stops,
    format_node_stop,
    parse_node_stop,
    stop_of,
    tails,
    total,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND

GRACE, LIMIT = 10 * SECOND, 300 * SECOND
RECORDER = NodeStop("recorder", 200 * SECOND, ("camera", "arm"))
UPLOAD = NodeStop("upload", 0, ("recorder",))
NODES = ["camera", "arm", "recorder", "upload"]


def test_the_command_line() -> None:
    text = "within=3min 20s,after=camera arm"
    assert format_node_stop(RECORDER) == text
    assert parse_node_stop(text) == RECORDER._replace(node="")
    assert parse_node_stop("after=recorder") == UPLOAD._replace(node="")


def test_one_node_needs_no_list() -> None:
    assert stop_of({"after": "camera"}) == NodeStop("", 0, ("camera",))
    assert stop_of({"after": ["camera", "camera"]}).after == ("camera",)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"withn": "5s"}, "unknown key 'withn'"),
        ({}, "it has neither within nor after"),
        ({"after": []}, "it has neither within nor after"),
        ({"within": "5"}, "within is '5'"),
        ({"within": "soon"}, "within is 'soon'"),
        ({"within": "0s"}, "within is '0s'"),
        ({"within": "infinity"}, "within is 'infinity'"),
        ({"after": ["a b"]}, "'a b' is no node"),
    ],
)
def test_what_is_no_stop(values: dict[str, str | list[str]], words: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot read the stop of a node: ") as caught:
        stop_of(values)
    assert words in caught.value.message
    assert caught.value.code == ExitCode.USAGE


def test_the_longest_row_of_nodes_is_the_time_of_a_stop() -> None:
    stops = {one.node: one for one in (RECORDER, UPLOAD)}
    # Each node gets SIGKILL half a grace duration after its time.
    assert tails(stops, GRACE) == {
        "upload": 0,
        "recorder": 15 * SECOND,
        "camera": 220 * SECOND,
        "arm": 220 * SECOND,
    }
    assert total(stops, GRACE) == 235 * SECOND
    assert total({}, GRACE) == 15 * SECOND


def test_many_ways_through_the_nodes_take_no_time() -> None:
    stops = {
        f"{layer}{side}": NodeStop(f"{layer}{side}", SECOND, (f"{layer - 1}a", f"{layer - 1}b"))
        for layer in range(1, 500)
        for side in "ab"
    }
    assert total(stops, GRACE) == 499 * 6 * SECOND + 15 * SECOND


def _refusal(*stops: NodeStop, grace: int = GRACE, limit: int = LIMIT) -> DoraSystemdError:
    with pytest.raises(DoraSystemdError) as caught:
        check_stops(stops, limit, grace, NODES)
    assert caught.value.code == ExitCode.BAD_INPUT
    assert caught.value.hint
    return caught.value


def test_what_no_dataflow_can_have() -> None:
    assert _refusal(NodeStop("arm", 0, ("camra",))).hint == "did you mean camera?"
    itself = _refusal(NodeStop("arm", 0, ("arm",)))
    assert itself.message == "cannot stop arm after arm: that is a circle"
    circle = _refusal(RECORDER, UPLOAD, NodeStop("arm", 0, ("upload",)))
    assert "that is a circle" in circle.message
    for node in ("arm", "recorder", "upload"):
        assert node in circle.message


def test_a_stop_fits_its_limit() -> None:
    late = _refusal(RECORDER, limit=200 * SECOND)
    assert late.message == (
        "cannot give the node recorder 3min 20s to stop: a stop would take 3min 40s, "
        "and stop_limit is 3min 20s"
    )
    assert "infinity" in _refusal(UPLOAD, grace=INFINITY).message
    check_stops((RECORDER, UPLOAD), 235 * SECOND, GRACE, NODES)
    check_stops((), 0, GRACE, NODES)

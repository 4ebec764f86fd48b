"""Frames of dora 1.1, as they were seen on the wire."""

import json
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.exits import Exit, exit_of, parse_exit
from dora_systemd.decisions.dora import life_events, protocol
from dora_systemd.decisions.dora.protocol import LogRecord, Reply
from dora_systemd.decisions.life import events as life
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import INFINITY

RUN = "01a1fb9e-9464-7aee-adce-79cf1bfc2b24"


def log_frame(message: str, target: str = "daemon", node: str | None = "a") -> str:
    payload = {"level": "DEBUG", "target": target, "node_id": node, "message": message}
    return json.dumps({"event": "log", "payload": payload})


def event(message: str, target: str = "daemon", node: str | None = "a") -> life.Event | None:
    record = protocol.parse_frame(log_frame(message, target, node))
    assert isinstance(record, LogRecord)
    return life_events.parse_life_event(record, 5)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (event("spawned node with pid 14626", "spawner"), life.NodeSpawned(5, "a", 14626)),
        (event("node is ready"), life.NodeReady(5, "a")),
        (
            event("handling node stop with exit status Success (restart: false, restart_count: 0)"),
            life.NodeExited(5, "a", Exit(), False),
        ),
        (
            event(
                "handling node stop with exit status ExitCode(3) (restart: true, restart_count: 1)"
            ),
            life.NodeExited(5, "a", exit_of(3), True),
        ),
        (
            event(
                "handling node stop with exit status Signal(9) (restart: false, restart_count: 0)"
            ),
            life.NodeExited(5, "a", exit_of(-9), False),
        ),
        (
            event("marking `camera` as cascading error caused by `opnode`"),
            life.NodeCascaded(5, "camera", "opnode"),
        ),
        (event("all nodes are ready, starting dataflow", node=None), life.AllReady(5)),
        (
            event("startup barrier completed by a node exit, starting dataflow", node=None),
            life.AllReady(5),
        ),
        (event("dataflow finished", "coordinator", None), life.RunFinished(5)),
        (event("dataflow finished on machine `x`", "daemon", None), None),
        (event("node is ready", "stdout"), None),
        (event("node is ready", ""), None),
        (event("spawning `/bin/sh` in `/run`", "spawner"), None),
    ],
)
def test_life_events(found: life.Event | None, expected: life.Event | None) -> None:
    assert found == expected


def test_results() -> None:
    err = {"cause": {"Other": {"stderr": "x"}}, "exit_status": {"ExitCode": 1}}
    cascading = {"cause": {"Cascading": {"caused_by_node": "a"}}, "exit_status": {"Signal": 15}}
    grace = {"cause": "GraceDuration", "exit_status": {"Signal": 9}}
    spawn = {"cause": {"FailedToSpawn": "no\n\nLocation:\n  x"}, "exit_status": "Unknown"}
    nodes = {
        "ok": {"Ok": None},
        "a": {"Err": err},
        "b": {"Err": cascading},
        "c": {"Err": grace},
        "d": {"Err": spawn},
    }
    reply = Reply("1", {"DataflowStopped": {"uuid": RUN, "result": {"node_results": nodes}}}, "")
    assert protocol.parse_results(reply) == {
        "a": exit_of(1),
        "b": parse_exit("signal SIGTERM because node a failed"),
        "c": parse_exit("signal SIGKILL after the grace duration"),
        "d": parse_exit("failed to spawn: no"),
        "ok": Exit(),
    }
    assert protocol.parse_results(Reply("1", {"DataflowSpawned": {"uuid": RUN}}, "")) is None
    assert protocol.parse_results(Reply("1", None, "no such dataflow")) == {}


def test_requests_and_replies() -> None:
    ident, text = protocol.encode_request(protocol.stop_params(RUN, 2_500_000))
    frame = json.loads(text)
    assert frame["id"] == ident
    assert frame["method"] == "control"
    assert frame["params"]["Stop"]["grace_duration"] == {"secs": 2, "nanos": 500_000_000}
    good = protocol.parse_frame(json.dumps({"id": ident, "result": {"DaemonConnected": True}}))
    assert isinstance(good, Reply)
    assert protocol.result_of(good, "DaemonConnected") is True
    for bad in ({"error": "no"}, {"result": {"Error": "no"}}, {"result": "DestroyOk"}):
        reply = protocol.parse_frame(json.dumps({"id": ident, **bad}))
        assert isinstance(reply, Reply)
        with pytest.raises(DoraSystemdError, match=r"^cannot "):
            protocol.result_of(reply, "DaemonConnected")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


@given(st.text() | json_values.map(json.dumps))
def test_no_frame_breaks_the_parser(text: str) -> None:
    frame = protocol.parse_frame(text)
    if isinstance(frame, LogRecord):
        event = life_events.parse_life_event(frame, 1)
        assert event is None or event.at_us == 1
    if isinstance(frame, Reply):
        results = protocol.parse_results(frame)
        assert results is None or {*map(type, results.values())} <= {Exit}


@given(
    st.fixed_dictionaries(
        {
            "id": st.just("1"),
            "result": st.dictionaries(
                st.sampled_from(["DataflowStopped", "Error", "x"]), json_values
            ),
        }
    )
)
def test_no_reply_breaks_the_results(frame: object) -> None:
    reply = protocol.parse_frame(json.dumps(frame))
    assert isinstance(reply, Reply)
    protocol.parse_results(reply)


def _daemon(machine: str | None, age: int) -> dict[str, object]:
    return {"daemon_id": {"machine_id": machine}, "last_heartbeat_ago_ms": age}


@pytest.mark.parametrize(
    ("result", "age"),
    [
        ({"ConnectedDaemons": [{"last_heartbeat_ago_ms": 2302}]}, 2_302_000),
        ({"ConnectedDaemons": [{"daemon_id": {}}]}, 0),
        ({"ConnectedDaemons": [_daemon("gpu", 10), _daemon(None, 30_000)]}, 30_000_000),
        ({"ConnectedDaemons": [_daemon("gpu", 10)]}, INFINITY),
        ({"ConnectedDaemons": [{"last_heartbeat_ago_ms": [None]}]}, 0),
        ({"ConnectedDaemons": []}, INFINITY),
        ({"ConnectedMachines": ["a"]}, 0),
        (None, 0),
    ],
)
def test_heartbeat(result: object, age: int) -> None:
    assert protocol.parse_heartbeat(Reply("1", result, "")) == age


def test_the_heartbeats_of_all_machines() -> None:
    daemons = [_daemon("gpu", 10), _daemon(None, 30_000), {"daemon_id": {"machine_id": "arm"}}]
    reply = Reply("1", {"ConnectedDaemons": daemons}, "")
    assert protocol.parse_heartbeats(reply) == [("gpu", 10_000), ("", 30_000_000), ("arm", 0)]
    assert protocol.parse_heartbeats(Reply("1", None, "")) == []


@pytest.mark.parametrize(
    ("target", "message", "is_end"),
    [
        ("coordinator", "all daemons running this dataflow disconnected; waiting for it", True),
        ("coordinator", "dataflow finished", False),
        ("stdout", "all daemons running this dataflow disconnected; says a node", False),
    ],
)
def test_the_end_of_a_subscription(target: str, message: str, is_end: bool) -> None:
    assert protocol.ends_subscription(LogRecord("warn", target, "", message)) == is_end


@pytest.mark.parametrize(
    ("error", "failure"),
    [
        ("", ""),
        # On a slow machine a short run is over before dora is asked.
        (f"unknown dataflow {RUN}", ""),
        (f"unknown dataflow {RUN}\n\nLocation:\n    coordinator.rs:1", ""),
        ("dataflow failed to start:\n  a: failed", "dataflow failed to start: a: failed"),
    ],
)
def test_spawn_failures(error: str, failure: str) -> None:
    assert protocol.parse_spawn_failure(Reply("1", None, error)) == failure


def test_what_nobody_who_is_dora_would_send() -> None:
    """Over a relay it is the owner of the dataflow who answers, with dora or without."""
    assert protocol.parse_frame("[" * 100_000) is None
    errors: list[object] = [5, [], {"a": ["\x1b"]}, True]
    for error in errors:
        for frame in ({"id": "x", "error": error}, {"id": "x", "result": {"Error": error}}):
            reply = protocol.parse_frame(json.dumps(frame))
            assert isinstance(reply, protocol.Reply)
            assert reply.error == "an error without words"


@pytest.mark.parametrize(
    ("kind", "number", "text"),
    [
        ("Success", None, ""),
        ("ExitCode", 3, "exit code 3"),
        ("Signal", 9, "signal SIGKILL"),
        ("Signal", 200, "signal 200"),
        ("Signal", None, "unknown exit status"),
        ("ExitCode", None, "unknown exit status"),
        ("", None, "unknown exit status"),
    ],
)
def test_exit_value(kind: str, number: object, text: str) -> None:
    assert str(protocol.exit_value(kind, number)) == text


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("no\n\n  Location:\n    a.rs:1", "no"),
        ("no\n room\nStack backtrace:\n 1", "no room"),
        ("Location of x is unknown\nSuggestion: y", "Location of x is unknown"),
        ("no\nLocations", "no Locations"),
        ("\n" * 1_000_000 + "x", "x"),  # once took hours
        ("", ""),
    ],
)
def test_an_error_without_its_place(text: str, line: str) -> None:
    assert protocol.first_line(text) == line


def test_a_frame_that_takes_much_memory_is_not_parsed() -> None:
    """A coordinator is its user's, and root's doractl and gateway send it requests."""
    for size, is_read in ((protocol.MOST_FRAME, True), (protocol.MOST_FRAME + 1, False)):
        frame = '{"id": "a", "result": "%s"}'
        text = frame % ("x" * (size - len(frame) + 2))
        assert len(text) == size
        assert (protocol.parse_frame(text) is not None) == is_read
    tracemalloc.start()
    try:
        assert protocol.parse_frame('{"id": "a", "result": [' + "[]," * 10_000_000 + "0]}") is None
        assert tracemalloc.get_traced_memory()[1] < 100_000_000
    finally:
        tracemalloc.stop()

"""dora's control protocol as the gateway speaks it: frames and forms, without any system."""

import asyncio
import inspect
import json
import re
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.client import ClientProtocol
from websockets.uri import parse_uri

from dora_systemd.adapters.dora.control import Connection
from dora_systemd.adapters.dora.websocket import WebSocket
from dora_systemd.decisions.cell.extra import RECORDER, extra_id
from dora_systemd.decisions.gateway.answers import (
    bare_descriptor,
    dataflow_list,
    is_wanted,
    log_line,
    node_list,
    restored_descriptor,
    stopped,
)
from dora_systemd.decisions.gateway.frames import (
    Malformed,
    Request,
    error_result,
    logs_parts,
    parse_request,
    refused_version,
    renamed,
    sent_flags,
)
from dora_systemd.decisions.gateway.request import Request as HttpRequest
from dora_systemd.decisions.logs.records import log_payload
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control.jobs import find_file
from dora_systemd.gateway.control.serve import HANDLERS, REFUSED, serve_control
from dora_systemd.gateway.control.session import Talk
from dora_systemd.scope import Scope
from tests.unit.fakes.ends import FakeWriter
from tests.unit.fakes.socket import FakeSocket

UUID = "550e8400-e29b-41d4-a716-446655440000"
RUN = "01a1fb9e-9464-7aee-adce-79cf1bfc2b24"
VARIANTS = {
    *("Build", "WaitForBuild", "Start", "WaitForSpawn", "Reload", "Check", "Stop"),
    *("StopByName", "Restart", "RestartByName", "Logs", "Destroy", "List", "Clean", "Info"),
    *("DaemonConnected", "ConnectedMachines", "LogSubscribe", "BuildLogSubscribe"),
    *("CliAndDefaultDaemonOnSameMachine", "GetNodeInfo", "TopicSubscribe"),
    *("TopicUnsubscribe", "GetTraces", "GetTraceSpans", "RestartNode", "StopNode"),
    *("TopicPublish", "GetParams", "GetParam", "SetParam", "DeleteParam", "AddNode"),
    *("RemoveNode", "ReplaceNode", "AddMapping", "RemoveMapping", "Hello"),
}
"""All that a coordinator of dora 1.1 knows, from its error about one that it does not know."""


def frame(params: Any) -> str:
    return json.dumps({"id": "x", "method": "control", "params": params})


def test_every_request_of_dora_is_answered_or_refused() -> None:
    assert HANDLERS.keys() | REFUSED.keys() == VARIANTS
    assert not HANDLERS.keys() & REFUSED.keys()
    for message, hint in REFUSED.values():
        assert message.startswith("cannot ")
        assert hint


@pytest.mark.parametrize(
    ("params", "name", "body"),
    [
        ("List", "List", {}),
        ({"List": None}, "List", {}),
        ({"Check": {"dataflow_uuid": UUID}}, "Check", {"dataflow_uuid": UUID}),
    ],
)
def test_requests(params: Any, name: str, body: dict[str, str]) -> None:
    assert parse_request(frame(params)) == Request("x", name, body)


@pytest.mark.parametrize(
    "text",
    [
        b"\x00\xff",
        "",
        "{",
        "[]",
        "null",
        '"List"',
        "{}",
        '{"id": 7, "params": "List"}',
        frame(None),
        frame([]),
        frame({}),
        frame({"Stop": {}, "List": {}}),
        frame({"Stop": "now"}),
        frame({"Stop": {"name": "\ud800"}}),
        frame({"Start": {"local_working_dir": "/\0"}}),
        frame({"Start": {"local_working_dir": "/\\\0"}}),
        frame({"St\0op": {}}),
        "[" * 100_000,
    ],
)
def test_frames_that_are_none(text: str | bytes) -> None:
    found = parse_request(text)
    assert isinstance(found, Malformed)
    assert found.reason.startswith("cannot ")


def test_a_backslash_is_no_nul() -> None:
    text = frame({"Start": {"local_working_dir": r"/\u0000"}})
    assert isinstance(parse_request(text), Request)


def test_the_fields_of_a_request() -> None:
    request = Request("x", "Stop", {"grace_duration": {"secs": 2, "nanos": 500_000_000}})
    assert request.grace == 2_500_000
    for given_ in (None, 3, {"secs": "2", "nanos": 0}, {"secs": 2}):
        assert Request("x", "Stop", {"grace_duration": given_}).grace is None
    assert [Request("x", "Logs", {"tail": n}).tail for n in (5, None, -1, "5")] == [5] + [None] * 3
    for bad in ({}, {"dataflow_uuid": 7}, {"dataflow_uuid": "x"}, {"dataflow_id": "../x"}):
        with pytest.raises(DoraSystemdError):
            _ = Request("x", "Check", bad).dataflow
    assert Request("x", "Check", {"dataflow_id": UUID.upper()}).dataflow == UUID


def test_errors_are_printed_with_their_hint() -> None:
    error = DoraSystemdError("cannot stop x", "doractl list", ExitCode.NOT_FOUND)
    assert error_result(error) == {"Error": "cannot stop x\n\n  hint: doractl list"}
    assert error_result(DoraSystemdError("cannot stop x")) == {"Error": "cannot stop x"}


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_bytes_are_sent_as_numbers(lines: list[bytes]) -> None:
    found = json.loads("".join(logs_parts("x", lines)))
    assert found == {"id": "x", "result": {"Logs": list(b"".join(lines))}}


def test_long_logs_come_in_small_parts() -> None:
    parts = list(logs_parts("x", [b"0123456789" * 10_000] * 30))
    assert max(map(len, parts)) < 4 << 20
    assert sum(part.count(",") for part in parts) > 2_900_000


def test_ids_of_runs_become_those_of_dataflows() -> None:
    answer = {"NodeStopped": {"dataflow_id": RUN, "node_id": "a"}, "text": f"in `{RUN}`"}
    expected = {"NodeStopped": {"dataflow_id": UUID, "node_id": "a"}, "text": f"in `{UUID}`"}
    assert renamed(answer, RUN, UUID) == expected
    assert renamed("ParamSet", "", UUID) == "ParamSet"


def test_versions() -> None:
    assert refused_version("1.1.0") is None
    assert refused_version("1.0.0-rc.4") is None
    for version in ("2.0.0", "0.5.0", "", None, 1, "10.0"):
        assert "version mismatch" in (refused_version(version) or "")


def row(name: str, status: str, *nodes: NodeRow) -> DataflowRow:
    return DataflowRow(UUID, name, f"dora-{name}.service", status, nodes=nodes)


def test_lists() -> None:
    words = ("Running", "Degraded", "Starting", "Restarting", "Failed", "Finished", "Stopped")
    found = dataflow_list(row(f"x{n}", word) for n, word in enumerate(words))["DataflowList"]
    states = [one["status"] for one in found]
    assert states == ["Running"] * 4 + ["Failed", "Finished", "Finished"]
    assert found[0]["id"] == {"uuid": UUID, "name": "x0"}
    nodes = [
        NodeRow("a", "running", 7, 12.5, 3_000_000, restarts=2),
        NodeRow("b", "failed"),
        NodeRow("c", "reloading"),
        NodeRow("d", "unknown"),
    ]
    infos = node_list([row("robot", "Running", *nodes)])["NodeInfoList"]
    assert [one["metrics"]["status"] for one in infos] == [
        *("running", "failed", "restarting", "running")
    ]
    first = infos[0]
    assert (first["dataflow_id"], first["dataflow_name"], first["node_id"]) == (UUID, "robot", "a")
    metrics = first["metrics"]
    assert (metrics["pid"], metrics["cpu_usage"], metrics["memory_mb"]) == (7, 12.5, 3.0)
    assert metrics["restart_count"] == 2
    assert infos[1]["metrics"]["memory_mb"] == 0.0


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ("node a: exit code 3 after 2 restarts", {"ExitCode": 3}),
        ("signal SIGKILL", {"Signal": 9}),
        ("signal SIGNONE", "Unknown"),
        ("used up its memory limit", "Unknown"),
    ],
)
def test_results(text: str, status: Any) -> None:
    result = stopped(UUID, 1_500_000, {"a": text})["DataflowStopped"]["result"]
    error = result["node_results"]["a"]["Err"]
    assert error["exit_status"] == status
    assert error["cause"] == {"Other": {"stderr": text}}
    assert error["timestamp"] == {
        "time": (1 << 32) + (1 << 31),
        "id": list(bytes.fromhex(UUID.replace("-", ""))),
    }
    assert stopped(UUID, 0, {})["DataflowStopped"]["result"]["node_results"] == {}


PLAIN = {
    "__REALTIME_TIMESTAMP": b"1795255620123456",
    "DORA_NODE": b"camera",
    "DORA_STREAM": b"stderr",
    "PRIORITY": b"5",
    "MESSAGE": b"caf\xc3\xa9 \xff",
}
TOLD = {**PLAIN, "DORA_LEVEL": b"warn", "DORA_TARGET": b"app::x"}
LIFE = {"__REALTIME_TIMESTAMP": b"1", "PRIORITY": b"5", "MESSAGE": b"Dataflow x runs"}


def test_lines_as_dora_has_them_in_its_files() -> None:
    assert json.loads(log_line(PLAIN)) == {
        "ts": "2026-11-21T10:07:00.123456Z",
        "level": "stdout",
        "node": "camera",
        "msg": "café \N{REPLACEMENT CHARACTER}",
    }
    assert log_line(PLAIN).endswith(b"}\n")
    assert log_line(PLAIN).isascii()
    told = json.loads(log_line(TOLD))
    assert (told["level"], told["target"]) == ("warn", "app::x")


def test_lines_that_are_followed() -> None:
    plain, told, life = (log_payload(one, UUID) for one in (PLAIN, TOLD, LIFE))
    assert (plain["level"], plain["target"], plain["node_id"]) == ("stdout", None, "camera")
    assert (told["level"], told["target"]) == ("WARN", "app::x")
    assert (life["level"], life["target"], life["node_id"]) == ("INFO", "dora-systemd", None)
    assert plain["dataflow_id"] == UUID


@pytest.mark.parametrize(
    ("level", "wanted"),
    [("TRACE", [1, 1, 1]), ("INFO", [1, 1, 1]), ("Warn", [1, 1, 0]), ("ERROR", [1, 0, 0])],
)
def test_levels(level: str, wanted: list[int]) -> None:
    assert [is_wanted(one, level) for one in (PLAIN, TOLD, LIFE)] == list(map(bool, wanted))


def test_descriptors() -> None:
    assert bare_descriptor(["a"]) == {"nodes": [{"id": "a", "path": ""}]}
    node = {"id": "a", "path": "/bin/sh", "args": "x", "inputs": 1}
    running: dict[str, Any] = {"debug": 1, "nodes": [node]}
    written = [{"id": "a", "path": "a.py"}]
    added = {**running, "nodes": [node, {"id": extra_id(RECORDER, 1)}]}
    assert restored_descriptor(added, written, ("path", "args")) == {
        "debug": 1,
        "nodes": [{"id": "a", "path": "a.py", "inputs": 1}],
    }
    assert restored_descriptor(running, [], ("path", "args")) == running


@pytest.mark.parametrize(
    ("command", "path", "args"),
    [
        ("/venv/bin/python -u /x/a.py 'b c'", "/x/a.py", "'b c'"),
        ("uv run python -u /x/a.py", "/x/a.py", ""),
        ("uv run /x/tool -n", "/x/tool", "-n"),
        ("/x/tool -u 5", "/x/tool", "-u 5"),
        ("sh -c 'echo $X | cat'", "shell", "echo $X | cat"),
        ("sh -c 'exit 3'", "shell", "exit 3"),
    ],
)
def test_a_program_that_is_in_no_file(command: str, path: str, args: str) -> None:
    """A node of a module: what it runs is in what our launcher is told."""
    launched = {"id": "m.a", "path": "/bin/sh", "args": f"/p/launcher.pl m.a /x pipe {command}"}
    (node,) = restored_descriptor({"nodes": [launched]}, [], ("path", "args"))["nodes"]
    assert node == {"id": "m.a", "path": path, "args": args}


@pytest.mark.parametrize("directory", ["/nowhere", "nowhere"])
def test_a_directory_that_is_none(directory: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot (search for the dataflow|start) in"):
        find_file(Path(directory), "one")


def keep_session(directory: Path, stem: str, text: str) -> None:
    """What the dora command does before it sends a Start."""
    (directory / "out").mkdir(exist_ok=True)
    (directory / "out" / f"{stem}.dora-session.yaml").write_text(text)


def test_the_session_names_the_file(tmp_path: Path) -> None:
    for name in ("flow.yml", "twin.yml", "other.yml", "a.b.yaml", "flow.txt"):
        (tmp_path / name).write_text("nodes: []\n")
    keep_session(tmp_path, "flow", "session_id: one\n")
    keep_session(tmp_path, "twin", "session_id: two\n")
    keep_session(tmp_path, "a.b", "session_id: three\n")
    assert find_file(tmp_path, "one") == tmp_path / "flow.yml"
    assert find_file(tmp_path, "two") == tmp_path / "twin.yml"
    assert find_file(tmp_path, "three") == tmp_path / "a.b.yaml"


@pytest.mark.parametrize(
    ("files", "session", "reason"),
    [
        ((), "session_id: one\n", "no file in /.* has its session"),
        (("flow.txt",), "session_id: one\n", "no file in /.* has its session"),
        (("flow.yml",), "session_id: two\n", "no file in /.* has its session"),
        (("flow.yml",), "[one]\n", "no file in /.* has its session"),
        (("flow.yml",), "session_id: [\n", "no file in /.* has its session"),
        (("flow.yml", "flow.yaml"), "session_id: one\n", "flow.yaml, flow.yml have one session"),
    ],
)
def test_a_session_that_names_no_file(
    tmp_path: Path, files: tuple[str, ...], session: str, reason: str
) -> None:
    for name in files:
        (tmp_path / name).write_text("nodes: []\n")
    keep_session(tmp_path, "flow", session)
    expected = f"^cannot find out which file this dataflow is from: {reason}$"
    with pytest.raises(DoraSystemdError, match=expected) as caught:
        find_file(tmp_path, "one")
    assert caught.value.hint == "doractl start FILE takes the file itself"


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"write_events_to": "/tmp/x"}, "cannot write the events"),
        ({"dataflow": []}, "no dataflow was sent"),
        ({"session_id": None}, "it has no session_id"),
        ({"local_working_dir": ""}, "it has no local_working_dir"),
    ],
)
def test_a_start_that_is_refused(given: dict[str, Any], problem: str) -> None:
    body = {"dataflow": {}, "local_working_dir": "/nowhere", "session_id": "one", **given}
    (answer,) = talk(frame({"Start": body}))
    assert problem in answer["result"]["Error"]


# A file, and what the dora command sends for it.
WRITTEN: dict[str, Any] = {"env": {"KEPT": "1", "HERE": "$HOME"}, "nodes": [{"id": "a"}]}
SENT: dict[str, Any] = {
    "nodes": [{"id": "a", "env": None, "inputs": {"x": "a/x"}}],
    "debug": {"enable_debug_inspection": False},
    "exit_when_nodes_finish": None,
    "env": {"KEPT": 1, "HERE": "/root"},
}


def flags(uv: bool = False, **sent: Any) -> Any:
    body = json.loads(json.dumps({"dataflow": SENT | sent, "uv": uv}))
    return sent_flags(Request("x", "Start", body), WRITTEN)


def test_what_was_sent_becomes_flags() -> None:
    here = {"env": ("HERE=/root",)}  # the sender's value
    assert flags() == here
    assert flags(env={"KEPT": 2, "HERE": "$HOME", "N": 5, "B": True}) == {
        "env": ("KEPT=2", "N=5", "B=true")
    }
    assert flags(env=None) == {}
    assert flags(debug={"enable_debug_inspection": True}) == {**here, "debug": True}
    for ends in (True, False):
        expected = {**here, "exit_when_nodes_finish": ends}
        assert flags(exit_when_nodes_finish=ends) == expected
    assert flags(uv=True) == {**here, "uv": True}


def test_what_the_file_says_is_no_flag() -> None:
    written = {"exit_when_nodes_finish": True, "env": ["no mapping"]}
    body = {"dataflow": {**written, "env": {"A": "b"}}}
    assert sent_flags(Request("x", "Start", body), written) == {"env": ("A=b",)}


def test_numbers_that_json_cannot_hold() -> None:
    """The dora command sends null for them, whoever named them."""
    written = {"env": {"A": "inf", "B": "-NaN", "C": "${X}"}}
    body = {"dataflow": {"env": {"A": None, "B": None, "C": 1}}}
    assert sent_flags(Request("x", "Start", body), written) == {"env": ("C=1",)}
    for env in ({"C": None}, {"D": None}):
        with pytest.raises(DoraSystemdError, match=f"env '{next(iter(env))}' is infinite"):
            sent_flags(Request("x", "Start", {"dataflow": {"env": env}}), written)


def talk(*frames: str | bytes) -> list[Any]:
    socket = FakeSocket(frames)
    asyncio.run(serve_control(socket, HttpRequest("/api/control", Scope(True, 1000))))
    return socket.sent


def test_a_conversation() -> None:
    sent = talk(
        frame({"Hello": {"dora_version": "1.1.0"}}),
        "no frame",
        frame("DaemonConnected"),
        frame("Destroy"),
        frame("Dance"),
        frame({"Check": {}}),
        frame("CliAndDefaultDaemonOnSameMachine"),
    )
    assert sent[0] == {"id": "x", "result": {"HelloOk": {"dora_version": "1.1.0"}}}
    assert sent[1]["error"].startswith("cannot read the request")
    assert sent[2]["result"] == {"DaemonConnected": True}
    assert "doractl destroy" in sent[3]["result"]["Error"]
    assert "Dance" in sent[4]["result"]["Error"]
    assert "no dataflow_uuid" in sent[5]["result"]["Error"]
    assert sent[6]["result"]["CliAndDefaultDaemonIps"]["cli"] == "127.0.0.1"


def test_a_client_that_leaves_before_its_reply_keeps_no_connection() -> None:
    async def play() -> None:
        mine, reader = Talk(FakeSocket([]), Scope(True, 1000)), asyncio.StreamReader()
        writer = FakeWriter(reader)
        protocol = ClientProtocol(parse_uri("ws://127.0.0.1/"))
        socket = WebSocket(protocol, reader, cast(asyncio.StreamWriter, writer))
        mine.after_reply(asyncio.sleep(0))
        mine.topics["id"] = Connection(socket)
        await mine.end()
        assert writer.is_closed
        late = asyncio.sleep(0)
        with pytest.raises(DoraSystemdError, match="has disconnected"):
            mine.after_reply(late)
        assert inspect.getcoroutinestate(late) == inspect.CORO_CLOSED

    asyncio.run(play())


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["id", "params", "Hello", "Stop", "x"]), inner, max_size=3
        )
    ),
    max_leaves=8,
)


@given(st.lists(st.text() | st.binary() | JSON.map(json.dumps), min_size=1, max_size=5))
def test_nothing_that_is_sent_ends_it(frames: list[str | bytes]) -> None:
    texts = [one for one in frames if not re.search('"(Stop)"', str(one))]
    assert len(talk(*texts)) == len(texts)

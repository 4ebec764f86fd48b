"""What the status page and the gateway say to each other."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.environment import changes_entry
from dora_systemd.decisions.cell.options import parse_setting
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.gateway.page_messages import (
    MAX_ITEMS,
    MAX_TEXT,
    PROPERTIES,
    PageMessage,
    fact_values,
    graph_values,
    line_values,
    parse_message,
    saved_line,
    shown_values,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import escaped
from dora_systemd.values import INFINITY
from tests.unit.fakes.limit_values import limits_from
from tests.unit.fakes.manager import options, with_limits, with_texts


def test_messages() -> None:
    text = '{"type": "act", "action": "stop", "dataflow": "u", "node": "camera", "number": 7}'
    assert parse_message(text) == PageMessage("act", "u", "camera", "stop", 7)
    assert parse_message(b'{"type": "unfollow"}') == PageMessage("unfollow")
    text = '{"type": "act", "action": "set", "values": {"memory_limit": "6G", "hot_reload": "on"}}'
    values = {"memory_limit": "6G", "hot_reload": "on"}
    assert parse_message(text) == PageMessage("act", action="set", values=values)
    text = '{"type": "act", "action": "set", "values": {"nodes": "a:memory_limit=2G"}}'
    assert parse_message(text).values == {"nodes": "a:memory_limit=2G"}
    text = '{"type": "act", "action": "rollback", "dataflow": "u", "release": "2026"}'
    assert parse_message(text) == PageMessage("act", "u", action="rollback", release="2026")
    text = '{"type": "find", "search": "b\u00f6se", "run": "PREVIOUS", "since": "@7"}'
    assert parse_message(text) == PageMessage("find", search="böse", run="PREVIOUS", since="@7")


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "3", "null", '"follow"', "{}", '{"type": "kill"}', b"\xff"),
        *('{"type": "act", "action": "kill"}', '{"type": "follow", "node": 3}'),
        *('{"type": "follow", "number": "x"}', '{"type": ["follow"]}', "[" * 100_000),
        *('{"type": "follow", "number": 1e999}', '{"type": "follow", "number": null}'),
        *('{"type": "find", "run": "0190"}', '{"type": "find", "search": null}'),
        # No argument of a program can have these.
        *(r'{"type": "find", "search": "a\u0000b"}', r'{"type": "find", "since": "\ud800"}'),
        json.dumps({"type": "find", "search": "x" * 2000}),
        *('{"type": "act", "action": "set", "values": {"nice": "-20"}}', '{"values": 3}'),
        *('{"type": "act", "action": "set", "values": {"memory_limit": 3}}', '{"values": "x"}'),
        '{"type": "act", "action": "set", "values": {"hot_reload": "perhaps"}}',
        '{"type": "act", "action": "rollback", "release": 3}',
    ],
)
def test_what_is_no_message(text: str | bytes) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_message(text)
    assert caught.value.code is ExitCode.USAGE


@given(st.binary(max_size=60) | st.text(max_size=60) | st.from_type(dict).map(str))
def test_anything_else_is_refused(text: str | bytes) -> None:
    with pytest.raises(DoraSystemdError):
        parse_message(text)


def record(message: bytes, **fields: bytes) -> dict[str, bytes]:
    return {"MESSAGE": message, "__REALTIME_TIMESTAMP": b"17", **fields}


def test_lines() -> None:
    line = line_values(record(b"hello", PRIORITY=b"3", DORA_NODE=b"camera"))
    assert line == {"at_us": 17, "node": "camera", "text": "hello", "priority": 3, "event": ""}
    event = record(b"Node x crashed", DORA_EVENT=b"node-crashed", SYSLOG_IDENTIFIER=b"robot")
    assert line_values(event)["event"] == "node-crashed"
    assert line_values(record(b"x", SYSLOG_IDENTIFIER=b"robot/daemon"))["node"] == "daemon"


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (b"\x1b[1;31mred\x1b[0m", "red"),
        (b"\x1b]0;title\x07after", "after"),
        (b"\x1b[2J\x1b[Hcleared", "cleared"),
        (b"<script>alert(1)</script>", "<script>alert(1)</script>"),
        (b"two\nlines\tand\x00more", "two\nlines\tand\\x00more"),
        (b"\xff\xfe", "\ufffd\ufffd"),
        ("left \u202e right".encode(), r"left \u202e right"),
        (b"x" * (MAX_TEXT + 5), "x" * MAX_TEXT + "…"),
        (b"", ""),
    ],
)
def test_text_of_lines(message: bytes, text: str) -> None:
    assert line_values(record(message))["text"] == text


@given(st.binary(max_size=80))
def test_no_line_commands_a_terminal(message: bytes) -> None:
    text = line_values(record(message))["text"]
    json.dumps(text).encode()
    assert escaped(text) == text


def test_lines_of_a_file() -> None:
    line = {"at_us": 1_700_000_000_000_017, "node": "camera", "text": "two\nlines", "priority": 3}
    assert saved_line(line) == "2023-11-14T22:13:20.000017Z camera: two lines\n"
    assert saved_line({**line, "node": ""}).endswith("Z dataflow: two lines\n")
    assert saved_line({**line, "node": "a\n\x1b[2J"}).endswith("Z a \\x1b[2J: two lines\n")


def test_values_for_the_page() -> None:
    raw = {"a": ["\x1b[31mred\x1b[0m\x07", 3, None, True], "b": {"c": "x" * (MAX_TEXT + 1)}}
    assert shown_values(raw) == {"a": [r"red\x07", 3, None, True], "b": {"c": "x" * MAX_TEXT + "…"}}
    newest = shown_values(list(range(MAX_ITEMS + 5)))
    assert (len(newest), newest[-1]) == (MAX_ITEMS, MAX_ITEMS + 4)


def test_graph() -> None:
    nodes: list[dict[str, Any]] = [
        {
            "id": "camera",
            "path": "camera.py",
            "inputs": {"tick": "dora/timer/millis/100"},
            "outputs": ["image"],
            "env": {"TOKEN": "secret"},
        },
        {
            "id": "plot",
            "path": "plot.py",
            "inputs": {"picture": {"source": "camera/image", "queue_size": 2}},
        },
    ]
    values = graph_values(parse_dataflow({"nodes": nodes}, "flow.yml"))
    assert [one["id"] for one in values["nodes"]] == ["dora/timer/millis/100", "camera", "plot"]
    assert [one["kind"] for one in values["nodes"]] == ["dora", "python", "python"]
    assert [(one["from"], one["output"], one["to"]) for one in values["edges"]] == [
        ("dora/timer/millis/100", "", "camera"),
        ("camera", "image", "plot"),
    ]
    assert "secret" not in json.dumps(values)


UNSET = dict.fromkeys(PROPERTIES, INFINITY) | {
    "NoNewPrivileges": True,
    "MemoryDenyWriteExecute": False,
    "PrivateNetwork": False,
    "IPAddressDeny": [],
    "Environment": ["PATH=/bin"],
}


def facts(**unit: Any) -> dict[str, Any]:
    return fact_values(options(), {**UNSET, **unit})


def test_a_dataflow_without_any() -> None:
    assert facts() == {
        "nodes": [],
        "hot_reload": False,
        "sandbox": "default",
        "network": "host",
    }


def test_limits_are_what_set_takes() -> None:
    found = facts(MemoryMax=4 << 30, CPUQuotaPerSecUSec=1_500_000, MemorySwapMax=0, TasksMax=50)
    assert found["memory_limit"] == "4G"
    assert (found["cpu_limit"], found["tasks_limit"]) == ("150%", "50")
    assert found["swap_limit"] == "0", "no swap at all is a limit"


def test_changes_of_set_take_precedence() -> None:
    limits = limits_from("a:memory_limit=1G,cpu_limit=2")
    own = with_limits(with_texts(options(), "hot_reload=yes"), limits)
    texts = ("a:memory_limit=2G", "b:tasks_limit=9", "c:tasks_limit=infinity", "hot_reload=no")
    changes = [changes_entry(map(parse_setting, texts))]
    found = fact_values(own, {**UNSET, "Environment": changes})
    assert found["nodes"] == ["a:cpu_limit=200%,memory_limit=2G", "b:tasks_limit=9"]
    assert found["hot_reload"] is False
    assert fact_values(own, UNSET)["hot_reload"] is True


@pytest.mark.parametrize(
    ("unit", "sandbox", "network"),
    [
        ({"NoNewPrivileges": False}, "none", "host"),
        ({"MemoryDenyWriteExecute": True, "PrivateNetwork": True}, "strict", "private"),
        ({"IPAddressDeny": [(2, b"\0\0\0\0", 0)]}, "default", "loopback"),
    ],
)
def test_sandbox(unit: dict[str, Any], sandbox: str, network: str) -> None:
    found = facts(**unit)
    assert (found["sandbox"], found["network"]) == (sandbox, network)

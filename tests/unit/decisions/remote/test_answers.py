"""What comes from hosts, in order and without what is not theirs."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.remote.host_tables import format_hosts, row_of
from dora_systemd.decisions.remote.hosts import Host, parse_host
from dora_systemd.decisions.remote.merge import MOST_HELD, WINDOW_SECONDS, Merge
from dora_systemd.decisions.remote.ssh_failures import ending_error, is_of_ssh, last_line, unreached
from dora_systemd.decisions.remote.stream import (
    MAX_LINE,
    AfterMark,
    Lines,
    objects_of,
    read_object,
    with_host,
)
from dora_systemd.decisions.views.objects import dataflow_object, format_json
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import ExitCode

A = Host("alice@a", "alice@a")
ROBOT = DataflowRow(
    uuid="44f30e60-107e-41d2-b6a8-b30cefc153ae",
    name="robot",
    unit="dora-robot.service",
    status="Running",
    uptime=332_000_000,
    nodes_alive=2,
    nodes_total=2,
    cpu_percent=12.5,
    cpu_limit=50,
    memory=1 << 28,
    restarts=1,
    enabled=True,
)


@given(st.binary(max_size=50), st.binary(max_size=50), st.integers(1, 9))
def test_only_what_follows_the_mark(before: bytes, after: bytes, size: int) -> None:
    stream, data = AfterMark("mark"), before.replace(b"mark", b"") + b"mark\n" + after
    pieces = [stream.feed(data[at : at + size]) for at in range(0, len(data), size)]
    assert b"".join(pieces) == after
    assert stream.is_open


def test_without_a_mark_the_last_words_stay() -> None:
    stream = AfterMark("mark")
    assert stream.feed(b"x" * 100_000) == stream.feed(b"locked") == b""
    assert not stream.is_open
    assert stream.noise.endswith(b"locked")
    assert len(stream.noise) < 5000


def test_lines() -> None:
    lines = Lines()
    assert lines.feed(b"a\nb") == ["a"]
    assert lines.feed(b"c\n\xff\nd") == ["bc", "\ufffd"]
    assert (lines.flush(), lines.flush()) == (["d"], [])
    assert lines.feed(b"x" * (MAX_LINE + 1)) == ["x" * (MAX_LINE + 1)]


def test_objects_have_their_host() -> None:
    assert format_json(with_host({"schema": 2, "host": "b", "name": "x"}, "a")) == (
        '{"schema": 2, "host": "a", "name": "x"}'
    )
    assert objects_of('[{"name": 1}, {}]', "a") == [{"host": "a", "name": 1}, {"host": "a"}]
    assert objects_of('{"name": 1}', "a") == [{"host": "a", "name": 1}]
    assert read_object('{"name": 1}') == {"name": 1}
    for text in ("", "welcome", "[1]", "3", "[" * 100_000, "null"):
        assert objects_of(text, "a") is None
        assert read_object(text) is None


@pytest.mark.parametrize(
    ("status", "is_in", "said", "complaint", "message"),
    [
        (0, True, "", "", None),
        (4, True, "", "doractl: no dataflow", None),
        (
            *(255, False, "", "ssh: connect to host a port 22: Connection refused\n"),
            "cannot reach alice@a: connect to host a port 22: Connection refused",
        ),
        (
            *(255, False, "", "@@@\nIDENTIFICATION HAS CHANGED!\nHost key verification failed."),
            "cannot reach alice@a: the host key has changed",
        ),
        (255, False, "", "", "cannot reach alice@a: ssh failed"),
        (
            *(255, True, "", "trial: starting\nclient_loop: send disconnect: Broken pipe\r\n"),
            "the connection to alice@a is lost: client_loop: send disconnect: Broken pipe",
        ),
        (255, True, "", "trial: 1/1 nodes ready\n", "the connection to alice@a is lost"),
        (255, True, "", '{"progress": {}}\n', "the connection to alice@a is lost"),
        (-9, True, "", "", "the connection to alice@a is lost"),
        (127, True, "", "", "cannot find doractl on alice@a"),
        (1, False, "Not available.\n", "", "cannot run doractl on alice@a: Not available."),
        (0, False, "", "", "cannot run doractl on alice@a: its login shell ends at once"),
    ],
)
def test_how_a_talk_ends(
    status: int, is_in: bool, said: str, complaint: str, message: str | None
) -> None:
    error = ending_error(A, status, is_in, said, complaint)
    assert (error and error.message) == message
    assert error is None or (error.code is ExitCode.NO_HOST and error.hint)


def test_a_hint_is_a_command_of_ssh() -> None:
    assert unreached(parse_host("a:2222"), "odd").hint == "try: ssh -p 2222 a true"


@pytest.mark.parametrize(
    "said", ["", "kex_exchange_identification: read: Connection reset by peer"]
)
def test_a_host_that_closes_the_connection_at_once(said: str) -> None:
    """So does sshd for some time after failed logins; ssh may say nothing about it."""
    hint = "try: ssh a true; after failed logins sshd may refuse this machine for a while"
    assert unreached(parse_host("a"), said).hint == hint


def test_what_ssh_says_is_not_repeated() -> None:
    assert is_of_ssh(b"Connection to 10.0.0.1 closed by remote host.\r\n")
    assert is_of_ssh(b"client_loop: send disconnect: Broken pipe\r\n")
    assert not is_of_ssh(b"doractl: Connection to 10.0.0.1 closed by remote host.\n")


def test_words_of_a_host_are_one_line() -> None:
    assert last_line("a\n\x1b[31mb\x07\t" + "c" * 1000 + "\n\n").startswith("b\\x07 ccc")
    assert len(last_line("c" * 1000)) <= 200


def test_rows_of_objects() -> None:
    value: dict[str, Any] = dataflow_object(ROBOT)
    assert row_of(value) == ROBOT
    for wrong in ({}, {**value, "uuid": 1}, {**value, "memory_bytes": "x"}):
        assert row_of(wrong) is None
    for number in (True, -1, float("nan"), float("inf"), 1e300, [1]):
        assert row_of({**value, "uptime_us": number}) is None


def test_the_table() -> None:
    other = ROBOT._replace(name="arm\x1b[2J", uuid="54f30e60-107e-41d2-b6a8-b30cefc153ae")
    header, *rows = format_hosts({"a": [ROBOT], "b": None, "c": [], "d": [other]}).splitlines()
    assert header.split()[:5] == ["HOST", "UUID", "NAME", "STATUS", "UPTIME"]
    assert [row.split()[:4] for row in rows] == [
        ["a", "44f30e60", "robot", "Running"],
        ["d", "54f30e60", "arm\\x1b[2J", "Running"],
        ["b", "-", "-", "Unreachable"],
    ]
    by_name = format_hosts({"a": [ROBOT], "d": [other]}, sort_by="name")
    assert [line.split()[0] for line in by_name.splitlines()[1:]] == ["d", "a"]
    assert format_hosts({"a": []}) == ""
    for status in ("", " "):  # a host may say anything
        assert "robot" in format_hosts({"a": [ROBOT._replace(status=status)]}, 80, want_colors=True)
    assert max(map(len, format_hosts({"a" * 40: [ROBOT], "b": None}, 60).splitlines())) <= 60


def taken(merge: Merge, now: float = 0.0) -> list[bytes]:
    return [one.data for one in merge.take(now)]


def test_records_come_in_the_order_of_time() -> None:
    merge = Merge(["a", "b"], is_follow=False)
    merge.add("a", 1, b"a1", 0)
    merge.add("a", 3, b"a3", 0)
    assert taken(merge) == []
    merge.add("b", 2, b"b2", 0)
    assert taken(merge) == [b"a1", b"b2"]
    merge.end("b")
    assert taken(merge) == [b"a3"]
    assert merge.is_empty


def test_newest_first() -> None:
    merge = Merge(["a", "b"], is_follow=False, is_reverse=True)
    for host, at in (("a", 3), ("a", 1), ("b", 2)):
        merge.add(host, at, b"%d" % at, 0)
    merge.end("a")
    merge.end("b")
    assert taken(merge) == [b"3", b"2", b"1"]


def test_followed_records_wait_for_others() -> None:
    merge = Merge(["a", "b"], is_follow=True)
    merge.add("a", 2, b"late", 10.0)
    merge.add("b", 1, b"early", 10.0 + WINDOW_SECONDS / 2)
    assert taken(merge, 10.0 + WINDOW_SECONDS / 2) == []
    assert list(merge.take(99.0, is_complete=False)) == []
    assert taken(merge, 10.0 + 2 * WINDOW_SECONDS) == [b"early", b"late"]


@pytest.mark.parametrize("is_follow", [False, True])
def test_a_flood_waits_in_its_pipe(is_follow: bool) -> None:
    merge = Merge(["a", "b"], is_follow)
    for at in range(MOST_HELD):
        assert not merge.is_full("a")
        merge.add("a", at, b"", 0.0)
    assert merge.is_full("a")
    assert not merge.is_full("b")
    if is_follow:
        assert taken(merge) == [b""]
    else:
        merge.add("b", MOST_HELD, b"", 0.0)
        assert len(taken(merge)) == MOST_HELD
    assert not merge.is_full("a")

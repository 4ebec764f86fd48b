"""What head and member say to each other."""

import pytest

from dora_systemd.decisions.machines.wire import (
    Beat,
    Ended,
    Forwards,
    Lost,
    Message,
    Part,
    Ready,
    Refused,
    Run,
    StopPart,
    Table,
    expect,
    format_message,
    parse_message,
)
from dora_systemd.errors import DoraSystemdError

UUID = "3fa85f64-5717-4562-b3fc-2c963f66afa6"
PART = Part("robot", UUID, "gpu", "secret", 61000, 61001, "ab" * 32, 10_000_000, "0.1", "1.1.0")
MESSAGES = (
    PART,
    Forwards(61000, {"head": 61001, "gpu": 61002}),
    Lost("connect to host gpu port 22: Connection timed out"),
    Beat(),
    Ready("/run/dora/robot/work"),
    Table("{}"),
    Refused("its path a.py is not there", "copy it"),
    Ended("node a: exit code 1"),
    Run(UUID),
    StopPart(1_000_000),
)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda one: type(one).__name__)
def test_a_message_survives_the_way(message: Message) -> None:
    line = format_message(message)
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    assert parse_message(line) == message


def test_an_unknown_key_is_of_a_newer_version() -> None:
    assert parse_message(b'{"type": "beat", "more": 1}') == Beat()


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"Welcome to gpu",
        b"[]",
        b'{"type": "other"}',
        b'{"type": "lost"}',
        b'{"type": "lost", "words": 3}',
        b'{"type": "lost", "words": {"head": 1}}',
        b'{"type": "ready", "work": {}}',
        b'{"type": "table", "status": {}}',
        b'{"type": "run", "run": "../out"}',
        b'{"type": "ended", "reason": "\\ud800"}',
        b'{"type": "refused", "reason": "a\\u0000b"}',
        b'{"type": "forwards", "coordinator": {"head": 61000}, "zenoh": {}}',
        b'{"type": "forwards", "coordinator": 61000, "zenoh": 61001}',
        format_message(PART).replace(b'"secret"', b'{"head": 1}'),
        b'{"type": "stop", "grace": -1}',
        b'{"type": "stop", "grace": true}',
        b'{"type": "forwards", "coordinator": 22, "zenoh": {}}',
        b'{"type": "forwards", "coordinator": 61000, "zenoh": {"../x": 61001}}',
        format_message(PART).replace(b"robot", b"../robot"),
        b"[" * 100_000,
    ],
)
def test_what_is_no_message_is_refused(line: bytes) -> None:
    with pytest.raises(DoraSystemdError):
        parse_message(line)


def test_another_message_than_expected_is_refused() -> None:
    assert expect(Beat(), Beat) == Beat()
    with pytest.raises(DoraSystemdError):
        expect(Beat(), Ready)

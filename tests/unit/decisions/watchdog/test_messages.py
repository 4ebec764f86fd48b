"""Whatever a node sends is read, and controls nothing."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.views.formats import format_watchdog
from dora_systemd.decisions.watchdog.messages import (
    MAX_STATUS,
    Message,
    Sign,
    parse_message,
    parse_sign,
    sign_facts,
)
from dora_systemd.values import SECOND


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"WATCHDOG=1", Message(True)),
        (b"WATCHDOG=1\n", Message(True)),
        (b"STATUS=a b\nWATCHDOG=1", Message(True, status="a b")),
        (b"WATCHDOG=trigger", Message(is_trigger=True)),
        (b"WATCHDOG=2\nWATCHDOG_USEC=1\nREADY=1\nMAINPID=1\nFDSTORE=1", Message()),
        (b"STATUS=", Message(status="")),
        (b"STATUS=\x1b[31mred\x00\r\xe2\x80\xae\xff", Message(status="[31mred \ufffd")),
        (b"", Message()),
        (b"X_WATCHDOG=1\nwatchdog=1\nWATCHDOG", Message()),
    ],
)
def test_messages(data: bytes, message: Message) -> None:
    assert parse_message(data) == message


@given(st.binary(max_size=5000))
def test_any_message_is_read(data: bytes) -> None:
    status = parse_message(b"STATUS=" + data).status or ""
    assert status.isprintable()
    assert len(status) <= MAX_STATUS


@given(st.recursive(st.none() | st.integers() | st.floats() | st.text() | st.booleans(), st.lists))
def test_any_table_is_read(raw: object) -> None:
    assert isinstance(parse_sign(raw), Sign)


def test_signs_for_rows() -> None:
    assert parse_sign(["up", 5, 7]) == Sign("up", 5, 7)
    assert parse_sign(["up", True, 7]) == parse_sign(["up", -1, 7]) == Sign()
    sign = Sign("up", 2 * SECOND, 5 * SECOND)
    facts = {"text": "up", "watchdog": 5 * SECOND, "sign_age": SECOND}
    assert sign_facts(sign, 3 * SECOND) == facts
    assert sign_facts(sign, 0)["sign_age"] == 0
    assert sign_facts(Sign("idle"), 9) == {"text": "idle", "watchdog": None, "sign_age": None}
    assert format_watchdog(1_234_567, 5 * SECOND) == "1.2s/5s"
    assert format_watchdog(None, 5 * SECOND) == "-/5s"
    assert format_watchdog(None, None) == ""

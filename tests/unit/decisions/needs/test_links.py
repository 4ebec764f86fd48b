"""What the kernel answers of an interface, and what that means for a node."""

import struct

import pytest

from dora_systemd.decisions.needs.links import Link, format_link_request, link_problem, parse_link

UP, LOWER_UP, NO_ARP = 0x1, 0x10000, 0x80
CAN_FLAGS = UP | LOWER_UP | NO_ARP
SEQUENCE = 7
STATES = ("error-active", "error-warning", "error-passive", "bus-off", "stopped", "sleeping")
"""Of a CAN controller, in the order of linux/can/netlink.h."""


def attribute(kind: int, data: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(data), kind) + data + bytes(-len(data) % 4)


def answer(flags: int, *attributes: bytes, index: int = 5, kind: int = 16) -> bytes:
    """RTM_NEWLINK, as the kernel sends it."""
    body = struct.pack("=BxHiII", 0, 280, index, flags, 0) + b"".join(attributes)
    return struct.pack("=IHHII", 16 + len(body), kind, 0, SEQUENCE, 4711) + body


def can(state: int, driver: bytes = b"can\0") -> bytes:
    """IFLA_LINKINFO of a CAN interface; its kind, and in its data a bitrate and the state."""
    data = attribute(1, bytes(32)) + attribute(4, struct.pack("=I", state))
    return attribute(0x8000 | 18, attribute(1, driver) + attribute(0x8000 | 2, data))


def problem(flags: int, *attributes: bytes) -> str:
    link = parse_link(answer(flags, attribute(3, b"can0\0"), *attributes), SEQUENCE)
    assert link is not None
    return link_problem(link)


@pytest.mark.parametrize("state", range(len(STATES)))
def test_only_a_bus_that_is_off_cannot_be_used(state: int) -> None:
    is_off = STATES[state] == "bus-off"
    assert problem(CAN_FLAGS, can(state)) == ("bus-off" if is_off else "")
    # The kernel takes the carrier of a bus that is off.
    assert problem(CAN_FLAGS & ~LOWER_UP, can(state)) == ("bus-off" if is_off else "no carrier")
    assert problem(CAN_FLAGS & ~UP, can(state)) == "down"


def test_a_state_counts_only_for_can() -> None:
    assert problem(CAN_FLAGS, can(3, b"vcan\0")) == ""
    assert problem(CAN_FLAGS, attribute(18, attribute(1, b"can\0"))) == ""
    assert problem(CAN_FLAGS, attribute(18, attribute(1, b"can\0") + attribute(2, b""))) == ""


def test_an_interface_that_is_plugged_in_again_has_another_index() -> None:
    first, second = (parse_link(answer(UP | LOWER_UP, index=one), SEQUENCE) for one in (5, 6))
    assert (first, second) == (Link(5, True, True), Link(6, True, True))


def test_an_error_of_the_kernel_is_kept() -> None:
    error = struct.pack("=IHHIIi", 36, 2, 0, SEQUENCE, 0, -19) + bytes(16)
    assert parse_link(error, SEQUENCE) == Link(error=19)


def test_other_messages_are_no_answer() -> None:
    assert parse_link(answer(UP), SEQUENCE + 1) is None
    assert parse_link(answer(UP, kind=17), SEQUENCE) is None
    for size in range(32):
        assert parse_link(answer(UP)[:size], SEQUENCE) is None


def test_a_malformed_attribute_hides_only_what_follows() -> None:
    for broken in (struct.pack("=HH", 3, 18), struct.pack("=HH", 400, 18), b"\x08"):
        assert problem(CAN_FLAGS, can(3), broken) == "bus-off"
        assert problem(CAN_FLAGS, broken, can(3)) == ""


def test_a_request_names_the_interface() -> None:
    request = format_link_request("can0", SEQUENCE)
    assert struct.unpack_from("=IHHII", request) == (len(request), 18, 1, SEQUENCE, 0)
    assert request.endswith(attribute(3, b"can0\0"))
    assert len(format_link_request("x" * 15, SEQUENCE)) % 4 == 0

"""Network interfaces that nodes need: requests to the kernel and its answers. Pure.

See rtnetlink(7). The numbers are those of linux/netlink.h, linux/rtnetlink.h, linux/if_link.h and
linux/can/netlink.h.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

LINK_GROUP = 1
"""RTMGRP_LINK: interfaces that appear, change or disappear."""

_HEADER = struct.Struct("=IHHII")
_LINK = struct.Struct("=BxHiII")
_ATTRIBUTE = struct.Struct("=HH")
_NUMBER = struct.Struct("=I")
_ERROR_NUMBER = struct.Struct("=i")

_ERROR, _NEW_LINK, _GET_LINK = 2, 16, 18
_REQUEST = 1
_NAME, _LINK_INFO = 3, 18
_KIND, _DATA = 1, 2
_CAN_STATE, _BUS_OFF = 4, 3
_UP, _LOWER_UP = 0x1, 0x10000
_TYPE_BITS = 0x3FFF
"""The other two bits are flags of an attribute."""


class Link(NamedTuple):
    """The state of an interface."""

    number: int = 0  # its index; an interface that was removed and added again has another one
    is_up: bool = False
    has_carrier: bool = False
    is_bus_off: bool = False
    error: int = 0  # errno of the request


def format_link_request(name: str, sequence: int) -> bytes:
    """The request for one interface."""
    text = name.encode() + b"\0"
    attribute = _ATTRIBUTE.pack(_ATTRIBUTE.size + len(text), _NAME) + text
    attribute += bytes(-len(attribute) % 4)
    size = _HEADER.size + _LINK.size + len(attribute)
    head = _HEADER.pack(size, _GET_LINK, _REQUEST, sequence, 0)
    return head + _LINK.pack(0, 0, 0, 0, 0) + attribute


def parse_link(answer: bytes, sequence: int) -> Link | None:
    """The answer to the request with this number; None for other messages."""
    if len(answer) < _HEADER.size:
        return None
    _, kind, _, answered, _ = _HEADER.unpack_from(answer)
    body = answer[_HEADER.size :]
    if answered != sequence:
        return None
    if kind == _ERROR and len(body) >= _ERROR_NUMBER.size:
        return Link(error=-_ERROR_NUMBER.unpack_from(body)[0])
    if kind != _NEW_LINK or len(body) < _LINK.size:
        return None
    _, _, index, flags, _ = _LINK.unpack_from(body)
    is_bus_off = _is_bus_off(_attributes(body[_LINK.size :]))
    return Link(index, bool(flags & _UP), bool(flags & _LOWER_UP), is_bus_off)


def _is_bus_off(attributes: dict[int, bytes]) -> bool:
    info = _attributes(attributes.get(_LINK_INFO, b""))
    if info.get(_KIND, b"").rstrip(b"\0") != b"can":
        return False
    state = _attributes(info.get(_DATA, b"")).get(_CAN_STATE, b"")
    return len(state) == _NUMBER.size and _NUMBER.unpack(state)[0] == _BUS_OFF


def _attributes(data: bytes) -> dict[int, bytes]:
    """The attributes by type; those behind a malformed one are left out."""
    return dict(_each_attribute(data))


def _each_attribute(data: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + _ATTRIBUTE.size <= len(data):
        size, kind = _ATTRIBUTE.unpack_from(data, place)
        if size < _ATTRIBUTE.size or place + size > len(data):
            return
        yield kind & _TYPE_BITS, data[place + _ATTRIBUTE.size : place + size]
        place += size + -size % 4


def link_problem(link: Link) -> str:
    """Why the interface cannot be used, or "".

    A CAN bus that is error-passive still sends. One that is bus-off does not, until its driver or
    `ip link set can0 type can restart` starts it again.
    """
    if not link.is_up:
        return "down"
    if link.is_bus_off:
        return "bus-off"
    return "" if link.has_carrier else "no carrier"

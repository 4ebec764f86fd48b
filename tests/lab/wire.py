"""Frames between the lab and the agent in its machine, over one serial port.

A frame is a letter, a length, and so many bytes. To the agent: `R` a request (JSON), `I` standard
input (empty: its end), `W` the terminal's size. From it: `H` it has started, `O` and `E` output,
`X` the exit status, and `A` how many bytes it has read (see line.py). One command at a time. Also
imported by the agent, so: nothing but Python.
"""

import struct
from collections.abc import Callable

HEAD = struct.Struct(">cI")
PIECE = 65536


def pack_frame(kind: bytes, body: bytes = b"") -> bytes:
    return HEAD.pack(kind, len(body)) + body


def read_frame(read: Callable[[int], bytes]) -> tuple[bytes, bytes]:
    """EOFError when there is no whole frame."""
    kind, length = HEAD.unpack(read_exactly(read, HEAD.size))
    return kind, read_exactly(read, length)


def read_exactly(read: Callable[[int], bytes], count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = read(min(count - len(data), PIECE))
        if not piece:
            raise EOFError
        data += piece
    return data


def pack_size(rows: int, columns: int) -> bytes:
    """As the kernel wants it (struct winsize)."""
    return struct.pack("HHHH", rows, columns, 0, 0)

"""Malformed HTTP requests and WebSocket frames, the same ones for the same seed.

By hand, in the lab, with the gateway up: python -m tests.system.gatewayfuzz 10000
"""

import base64
import json
import random
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from dora_systemd.gateway.routes import GET, SOCKETS

PATIENCE = 30.0
"""Seconds within which the gateway must have closed a connection on which nothing more comes."""

_CLIENTS = 8
_PAUSE = 0.1
"""Seconds without an answer after which the client hangs up."""

_METHODS = (b"GET", b"POST", b"HEAD", b"PUT", b"get", b"G\0T", b"OPTIONS", b"CONNECT", b"PRI", b"")
_VERSIONS = (b"HTTP/1.1", b"HTTP/1.0", b"HTTP/2.0", b"HTTP/9", b"http/1.1", b"HTTP/1.1 x", b"")
_ENDS = (b"\r\n", b"\n", b"\r", b"\r\n\r\n", b"\0\r\n", b"")
_HOSTS = (b"127.0.0.1", b"localhost", b"evil.example", b"", b"[::1]:x", b"\xff", b"a" * 300)
_VALUES = (
    *(
        b"",
        b"0",
        b"-1",
        b"5",
        b"99999999999999999999",
        b"chunked",
        b"websocket",
        b"\xff\xfe",
        b"\0",
    ),
    *(b"Bearer ", b"Bearer \xff", b"Bearer " + b"a" * 64, b"keep-alive, Upgrade", b"x" * 9000),
)
_NAMES = (
    *(
        b"Content-Length",
        b"Transfer-Encoding",
        b"Upgrade",
        b"Connection",
        b"Authorization",
        b"Host",
    ),
    *(b"Origin", b"Cookie", b"Sec-WebSocket-Key", b"Sec-WebSocket-Version", b"Expect", b"\xc3\xa9"),
    *(b"Sec-WebSocket-Extensions", b"Sec-WebSocket-Protocol", b"X Y", b":", b"", b"a" * 9000),
)


def attack(port: int, seed: int, count: int) -> Counter[str]:
    """So many requests and conversations; what the gateway answered, by kind and status.

    Raises AssertionError for one that the gateway leaves open.
    """
    chance = random.Random(seed)
    kinds: list[tuple[str, Callable[[random.Random, int], list[bytes]]]] = [("http", _request)]
    if SOCKETS:
        kinds.append(("frames", _conversation))
    made = [(n, *kinds[n % len(kinds)]) for n in range(count)]
    talks = [(f"seed {seed}, number {n}", kind, make(chance, port)) for n, kind, make in made]
    with ThreadPoolExecutor(_CLIENTS) as clients:
        answers = clients.map(lambda talk: (talk[1], exchange(port, talk[2], talk[0])), talks)
        return Counter(
            f"{kind} {text[9:12].decode(errors='replace') or 'closed'}" for kind, text in answers
        )


def exchange(port: int, pieces: Sequence[bytes], what: str = "") -> bytes:
    """Send the pieces and hang up; what came back until the gateway hung up as well."""
    received = bytearray()
    deadline = time.monotonic() + PATIENCE
    with (
        socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as connection,
        suppress(ConnectionError),  # it did not want to read all of that
    ):
        connection.sendall(pieces[0])
        if b"Sec-WebSocket-Key" in pieces[0]:
            received += connection.recv(65536)
        for piece in pieces[1:]:
            connection.sendall(piece)
        connection.settimeout(_PAUSE)
        while time.monotonic() < deadline:
            try:
                if not (chunk := connection.recv(65536)):
                    return bytes(received)
            except TimeoutError:
                connection.shutdown(socket.SHUT_WR)
            else:
                received += chunk
        raise AssertionError(f"left open: {what}, {pieces!r:.300}")
    return bytes(received)


def _request(chance: random.Random, port: int) -> list[bytes]:
    shape = chance.random()
    if shape < 0.1:
        return [chance.randbytes(chance.choice((1, 10, 100, 5000, 40000)))]
    text = _damaged(chance, _head(chance, port)) if shape < 0.4 else _odd(chance, port)
    cut = chance.randrange(len(text) + 1) if text and chance.random() < 0.2 else len(text)
    middle = chance.randrange(cut + 1)
    return [text[:middle], text[middle:cut]]


def _head(chance: random.Random, port: int, path: str = "") -> bytes:
    """A request that is all right."""
    paths = [
        *GET,
        *SOCKETS,
        "/nothing",
        "/?a=b",
        "/%00",
        "//",
        "/../..",
        "*",
        "http://x/y",
        "/" * 50,
    ]
    return (
        f"GET {path or chance.choice(paths)} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
        f"User-Agent: fuzz\r\nAccept: */*\r\n\r\n"
    ).encode()


def _damaged(chance: random.Random, text: bytes) -> bytes:
    data = bytearray(text)
    for _ in range(chance.randrange(1, 8)):
        place = chance.randrange(len(data))
        match chance.randrange(4):
            case 0:
                data[place] = chance.randrange(256)
            case 1:
                del data[place : place + chance.randrange(1, 5)]
            case 2:
                data[place:place] = chance.choice((b"\r\n", b"\0", b" ", b"\t", b":", b"\xff" * 9))
            case 3:
                data[place:place] = data[place : place + 200]
        if not data:
            break
    return bytes(data)


def _odd(chance: random.Random, port: int) -> bytes:
    """Well-formed lines that make no sense, or too many of them."""
    end = b"\r\n" if chance.random() < 0.8 else chance.choice(_ENDS)
    path = chance.choice([*GET, *SOCKETS, "/nothing", "/" + "a" * 9000]).encode()
    method = b"GET" if chance.random() < 0.8 else chance.choice(_METHODS)
    version = b"HTTP/1.1" if chance.random() < 0.9 else chance.choice(_VERSIONS)
    host = b"127.0.0.1:%d" % port if chance.random() < 0.7 else chance.choice(_HOSTS)
    lines = [b" ".join((method, path, version)), b"Host: " + host]
    count = chance.choice((0, 0, 0, 1, 2, 3, 5, 200))
    lines += [chance.choice(_NAMES) + b": " + chance.choice(_VALUES) for _ in range(count)]
    body = chance.randbytes(chance.choice((0, 0, 0, 10, 5000)))
    return end.join(lines) + 2 * end + body


def _conversation(chance: random.Random, port: int) -> list[bytes]:
    """A WebSocket connection that begins well."""
    key = base64.b64encode(chance.randbytes(16)).decode()
    path = chance.choice(sorted(SOCKETS))
    upgrade = (
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: {key}\r\n\r\n"
    )
    head = _head(chance, port, path).removesuffix(b"\r\n") + upgrade.encode()
    return [head, *(_frame(chance) for _ in range(chance.randrange(1, 6)))]


def _frame(chance: random.Random) -> bytes:
    if chance.random() < 0.2:
        return chance.randbytes(chance.choice((1, 2, 3, 14, 1000)))
    payload = _payload(chance)
    is_odd = chance.random() < 0.4
    opcode = chance.randrange(16) if is_odd else chance.choice((0, 1, 1, 1, 2, 8, 9, 10))
    first = opcode | (0x80 if chance.random() < 0.8 else 0)
    first |= chance.choice((0x10, 0x20, 0x40)) if is_odd and chance.random() < 0.3 else 0
    length = len(payload)
    if is_odd and chance.random() < 0.3:
        length = chance.choice((0, 1, 125, 126, 65535, 2**20 + 1, 2**32, 2**63 - 1, 2**64 - 1))
    masked = 0 if is_odd and chance.random() < 0.3 else 0x80
    head = bytes([first])
    if length < 126:
        head += bytes([masked | length])
    elif length < 65536:
        head += struct.pack(">BH", masked | 126, length)
    else:
        head += struct.pack(">BQ", masked | 127, length)
    mask = chance.randbytes(4) if masked else b""
    body = bytes(b ^ mask[n % 4] for n, b in enumerate(payload)) if mask else payload
    return head + mask + body


def _payload(chance: random.Random) -> bytes:
    match chance.randrange(6):
        case 0:
            return chance.randbytes(chance.choice((0, 1, 2, 125, 126, 3000)))
        case 1:
            return chance.choice((b"[" * 3000, b'{"a":' * 3000, b"9" * 5000, b"NaN", b"\xff", b""))
        case 2:
            return json.dumps(_value(chance, 3)).encode()
        case 3:
            return struct.pack(">H", chance.randrange(65536)) + b"bye"
    frame = {"id": _value(chance, 1), "method": "control", "params": _value(chance, 3)}
    for key in list(frame):
        if chance.random() < 0.1:
            del frame[key]
    return json.dumps(frame).encode()


def _value(chance: random.Random, depth: int) -> object:
    simple: list[object] = [None, True, -1, 0, 2**70, 1e308, "", "List", "x" * 500, "\0", "\ud800"]
    names = ["Logs", "Start", "Stop", "Check", "Info", "GetNodeInfo", "Hello", "uuid", "node", "id"]
    match chance.randrange(4) if depth else 0:
        case 1:
            return [_value(chance, depth - 1) for _ in range(chance.randrange(4))]
        case 2 | 3:
            return {chance.choice(names): _value(chance, depth - 1) for _ in range(2)}
    return chance.choice([*simple, *names])


if __name__ == "__main__":
    begin = time.monotonic()
    print(attack(53290, 7, int(sys.argv[1])), f"{time.monotonic() - begin:.0f} s")

"""The last messages of a recording, by its index, from a file that anybody may have written."""

import io
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.recorder.mcap import CHUNK_SIZE, McapWriter
from dora_systemd.decisions.recorder.mcap_reader import McapReader, Message

MOST = 1 << 30


def written(*messages: tuple[str, int, bytes], size: int = 1) -> bytes:
    """A file of messages with topic, sequence and schema."""
    out = io.BytesIO()
    file = McapWriter(out.write, "test")
    file.add_metadata("some", {"key": "value"})
    for topic, sequence, schema in messages:
        channel = file.channel(topic, "arrow" if schema else "json", schema)
        assert channel is not None
        file.message(channel, sequence, 1000 + sequence, 0, bytes([sequence % 256]) * size)
    file.finish()
    return out.getvalue()


def reader(data: bytes, most: int = MOST, seen: list[int] | None = None) -> McapReader:
    def read(at: int, size: int) -> bytes:
        if seen is not None:
            seen.append(size)
        return data[at : at + size]

    return McapReader(read, len(data), most)


THREE = (("a/x", 1, b"s"), ("a/y", 2, b"t"), ("a/x", 3, b"s"), ("a/x#metadata", 3, b""))


def test_the_last_message_of_each_topic() -> None:
    file = reader(written(*THREE))
    assert file.topics("arrow") == ["a/x", "a/y"]
    assert file.topics("json") == ["a/x#metadata"]
    assert file.last("a/x") == Message(b"s", 3, 1003, b"\3")
    assert file.last("a/y") == Message(b"t", 2, 1002, b"\2")
    assert file.last("a/x#metadata") == Message(b"", 3, 1003, b"\3")
    assert file.last("a/z") is None


def test_a_topic_with_several_schemas() -> None:
    file = reader(written(("a/x", 1, b"s"), ("a/x", 2, b"t"), ("a/x", 3, b"s"), ("a/x", 4, b"u")))
    assert file.topics("arrow") == ["a/x"]
    assert file.last("a/x") == Message(b"u", 4, 1004, b"\4")


def test_of_a_large_file_only_the_index_and_one_message_are_read() -> None:
    rows = [("a/x", at, b"s") for at in range(40)] + [("a/y", 99, b"t")]
    data = written(*rows, size=CHUNK_SIZE // 4)
    seen: list[int] = []
    last = reader(data, seen=seen).last("a/x")
    assert last is not None
    assert (last.sequence, len(last.data)) == (39, CHUNK_SIZE // 4)
    assert sum(seen) < CHUNK_SIZE // 2 < len(data) // 10


def test_a_message_that_is_too_large_is_not_read() -> None:
    seen: list[int] = []
    with pytest.raises(ValueError, match="too large"):
        reader(written(("a/x", 1, b"s"), size=5000), 4999, seen).last("a/x")
    assert max(seen) < 4999


@pytest.mark.parametrize(
    "change",
    [
        lambda _: b"",
        lambda data: data[:-1],
        lambda data: data[:-37] + bytes(37),
        lambda data: data[:-28] + b"\xff" * 8 + data[-20:],
    ],
)
def test_what_is_no_such_file(change: Callable[[bytes], bytes]) -> None:
    with pytest.raises(ValueError, match=r"end|place"):
        reader(change(written(*THREE)))


@given(st.data())
def test_changed_bytes_are_refused_or_read(data: st.DataObject) -> None:
    file = bytearray(written(*THREE))
    for _ in range(data.draw(st.integers(1, 4))):
        file[data.draw(st.integers(0, len(file) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = reader(bytes(file), 100)
        messages = [found.last(one) for one in found.topics("arrow")]
    except ValueError:
        return
    assert all(one is None or len(one.data) <= 100 for one in messages)

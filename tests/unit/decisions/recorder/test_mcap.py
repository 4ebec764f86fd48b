"""The MCAP file that is made of a ring."""

import io
import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.recorder.mcap import MOST_CHANNELS, McapWriter, Written, write_recording
from dora_systemd.decisions.recorder.reading import Reading
from dora_systemd.decisions.recorder.writer import Message
from tests.unit.checkout import CHECKOUT
from tests.unit.fakes.recorder.mcap import File
from tests.unit.fakes.recorder.ring import PAGE, MemoryStore, message, ring, writer
from tests.unit.tools import require_module

NOW = 1_790_000_000_000_000_000


def recording(store: MemoryStore, most: int = 1 << 30, **facts: str) -> tuple[File, Written]:
    out = io.BytesIO()
    written = write_recording(Reading(store, store.size, most), out.write, facts)
    return File(out.getvalue()), written


def test_each_output_is_a_topic_with_its_schema_and_dora_s_metadata() -> None:
    store, _ = ring(facts={"dataflow": "arm"})
    one = writer(store)
    one.put(0, Message(b"schema", b'{"width": 4}', b"image", NOW + 5, 5, NOW))
    one.put(1, Message(b"other", b"{}", b"angles", NOW + 6, 6, 0), dropped=2)
    file, written = recording(store, host="robot")
    assert [tuple(one) for one in file.messages] == [
        ("node/out0", "arrow", b"schema", 1, NOW + 5, NOW, b"image"),
        ("node/out0#metadata", "json", b"", 1, NOW + 5, NOW, b'{"width": 4}'),
        ("node/out1", "arrow", b"other", 2, NOW + 6, NOW + 6, b"angles"),
    ]
    zero = {"evicted": "0", "too_large": "0", "largest": "0"}
    common = {"recorded": "1", "received": "1", **zero}
    assert file.metadata == [
        ("dora-systemd output", {"output": "node/out0", "dropped": "0", **common}),
        ("dora-systemd output", {"output": "node/out1", "dropped": "2", **common}),
        ("dora-systemd", {"dataflow": "arm", "host": "robot", "damaged": "0", "cut": "no"}),
    ]
    assert written == Written(2, 2, 2, 0, False)


def test_a_schema_that_changes_is_another_channel_of_the_topic() -> None:
    store, _ = ring()
    one = writer(store)
    for schema in (b"a", b"b", b"a"):
        one.put(0, message(b"x", schema=schema))
    file, _ = recording(store)
    assert [(one.topic, one.schema) for one in file.messages] == [
        ("node/out0", schema) for schema in (b"a", b"b", b"a")
    ]
    assert len(file.channels) == 2


def test_a_ring_without_a_message_is_a_file() -> None:
    file, written = recording(ring()[0])
    assert (file.messages, written) == ([], Written(0, 0, 0, 0, False))


def test_a_file_that_is_cut_says_so() -> None:
    store, _ = ring(budget=16 * PAGE)
    for at in range(4):
        writer(store).put(0, message(bytes(4000), at))
    file, written = recording(store, 9000)
    assert (len(file.messages), written.is_cut) == (2, True)
    assert file.metadata[-1][1]["cut"] == "yes"


def test_a_ring_with_a_schema_for_each_message_makes_no_endless_file() -> None:
    out = io.BytesIO()
    file = McapWriter(out.write, "test")
    channels = [file.channel("x", "arrow", b"%d" % at) for at in range(MOST_CHANNELS + 1)]
    assert (channels[0], channels[-2], channels[-1]) == (0, MOST_CHANNELS - 1, None)


TIMES = st.integers(-(1 << 63), (1 << 63) - 1)
MESSAGES = st.tuples(
    st.integers(0, 1), st.binary(min_size=1, max_size=3), st.integers(0, 600_000), TIMES, TIMES
)


@given(st.lists(MESSAGES, max_size=6))
def test_every_file_is_whole(messages: list[tuple[int, bytes, int, int, int]]) -> None:
    store, _ = ring(budget=1024 * PAGE)
    one = writer(store)
    for output, schema, size, log, sent in messages:
        one.put(output, Message(schema, b"{}", bytes(size), log, 0, sent))
    file, written = recording(store)
    assert len(file.messages) == written.messages == len(messages)


def ten_lines(path: str) -> list[Any]:
    """Run the ten lines of dora-systemd-nodes(7)."""
    page = (CHECKOUT / "packaging/man/dora-systemd-nodes.7").read_text()
    code = page[page.index("import pyarrow as pa") :].partition("\n.Ed")[0]
    assert len(code.splitlines()) == 9
    found: list[Any] = []
    exec(code.replace("recording.mcap", path), {"print": lambda *words: found.append(words)})
    return found


def test_the_file_is_read_by_mcap_and_pyarrow(tmp_path: Any) -> None:
    arrow, reader = require_module("pyarrow"), require_module("mcap.reader")
    stream = require_module("mcap.stream_reader")
    values = arrow.array(range(1000), arrow.int32()), arrow.array(["a"])
    store, _ = ring(budget=64 * PAGE, facts={"dataflow": "arm"})
    one = writer(store)
    for at, value in enumerate(values):
        batch = arrow.RecordBatch.from_arrays([value], ["value"])
        schema = batch.schema.serialize().to_pybytes()
        one.put(at, Message(schema, b'{"a": 1}', batch.serialize(), NOW + at, at, 0))
    path = tmp_path / "recording.mcap"
    with path.open("wb") as file:
        write_recording(Reading(store, store.size, 1 << 30), file.write, {})
    assert ten_lines(str(path)) == [
        ("node/out0", NOW, values[0]),
        ("node/out1", NOW + 1, values[1]),
    ]
    with path.open("rb") as file:
        checked = reader.make_reader(file, validate_crcs=True)
        assert checked.get_summary().statistics.message_count == 4
        assert [one.name for one in checked.iter_metadata()][-1] == "dora-systemd"
        assert len(list(checked.iter_messages())) == 4
    data = path.read_bytes()
    assert len([*stream.StreamReader(io.BytesIO(data), validate_crcs=True).records]) > 4
    place = data.index(b'{"a": 1}')
    damaged = data[:place] + b"[" + data[place + 1 :]
    with pytest.raises(stream.CRCValidationError):
        list(stream.StreamReader(io.BytesIO(damaged), validate_crcs=True).records)


def test_a_large_message_is_written_without_a_copy() -> None:
    """The user of the nodes can have one that takes all that a reader may read."""
    data, sizes = bytes(16 << 20), list[int]()
    tracemalloc.start()
    try:
        file = McapWriter(lambda part: sizes.append(len(part)), "x")
        for number in range(2):
            channel = file.channel("a/b", "arrow", b"schema")
            assert channel is not None
            file.message(channel, number, NOW, NOW, data)
        file.finish()
        assert tracemalloc.get_traced_memory()[1] < len(data) // 2
    finally:
        tracemalloc.stop()
    assert 2 * len(data) < sum(sizes) < 2 * len(data) + 10_000


def test_a_file_with_large_messages_is_whole() -> None:
    out, datas = io.BytesIO(), [b"a" * 10, b"b" * (3 << 20), b"c" * 10]
    file = McapWriter(out.write, "x")
    for number, data in enumerate(datas):
        channel = file.channel("a/b", "arrow", b"schema")
        assert channel is not None
        file.message(channel, number, NOW, NOW, data)
    file.finish()
    assert [one.data for one in File(out.getvalue()).messages] == datas

"""Pictures of a ring, whose bytes anybody may have written."""

import base64
import json
import struct
import zlib
from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.recorder.pictures import (
    MOST_EACH,
    Picture,
    array_bytes,
    find_pictures,
    format_png,
    pixels_of,
)
from dora_systemd.decisions.recorder.reading import Recorded
from dora_systemd.decisions.recorder.ring import RecordHead

SCHEMA = base64.b64decode(
    "/////3gAAAAQAAAAAAAKAAwABgAFAAgACgAAAAABBAAMAAAACAAIAAAABAAIAAAABAAAAAEAAAAUAAAAEAAUAAgABgAH"
    "AAwAAAAQABAAAAAAAAECEAAAABwAAAAEAAAAAAAAAAUAAAB2YWx1ZQAGAAgABAAGAAAACAAAAAAAAAA="
)
"""Of pyarrow 26: one column of uint8, and a batch of the numbers from 0 to 23."""
BATCH = base64.b64decode(
    "/////4gAAAAUAAAAAAAAAAwAFgAGAAUACAAMAAwAAAAAAwQAGAAAABgAAAAAAAAAAAAKABgADAAEAAgACgAAADwAAAAQ"
    "AAAAGAAAAAAAAAAAAAAAAgAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAABgAAAAAAAAAAAAAAAEAAAAYAAAAAAAAAAAA"
    "AAAAAAAAAAECAwQFBgcICQoLDA0ODxAREhMUFRYX"
)
BODY = bytes(range(24))


def recorded(metadata: Mapping[str, object], body: bytes = BODY, number: int = 1) -> Recorded:
    data = BATCH.replace(BODY, body)
    meta = json.dumps(metadata).encode()
    head = RecordHead(0, number, 0, 0, 0, 0, len(meta), len(data))
    return Recorded(0, head, SCHEMA, meta, data)


def pictures(*messages: Recorded) -> list[Picture]:
    return list(find_pictures(messages))


def test_the_values_of_an_array() -> None:
    assert array_bytes(SCHEMA, BATCH) == BODY


@pytest.mark.parametrize(
    ("schema", "batch"),
    [
        (b"", BATCH),
        (SCHEMA, SCHEMA),
        (BATCH, BATCH),
        (SCHEMA, BATCH[:-10]),
        (SCHEMA.replace(b"\x01\x02\x10", b"\x01\x03\x10"), BATCH),
        (SCHEMA, BATCH[:20]),
    ],
)
def test_what_is_no_array_of_uint8(schema: bytes, batch: bytes) -> None:
    with pytest.raises((ValueError, struct.error)):
        array_bytes(schema, batch)


@given(st.data())
def test_changed_bytes_are_refused_or_read(data: st.DataObject) -> None:
    schema, batch = bytearray(SCHEMA), bytearray(BATCH)
    for _ in range(data.draw(st.integers(1, 4))):
        changed = data.draw(st.sampled_from([schema, batch]))
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = array_bytes(bytes(schema), bytes(batch))
    except (ValueError, struct.error):
        return
    assert len(found) <= len(BATCH)


def pixels(png: bytes) -> bytes:
    at, found = 8, {}
    while at < len(png):
        size, kind = struct.unpack_from(">I4s", png, at)
        data = png[at + 8 : at + 8 + size]
        assert struct.unpack_from(">I", png, at + 8 + size)[0] == zlib.crc32(kind + data)
        found[kind] = data
        at += 12 + size
    width, height, *kind_of = struct.unpack(">IIBBBBB", found[b"IHDR"])
    assert kind_of == [8, 2, 0, 0, 0]
    rows = zlib.decompress(found[b"IDAT"])
    assert len(rows) == height * (1 + 3 * width)
    return b"".join(rows[at + 1 :][: 3 * width] for at in range(0, len(rows), 1 + 3 * width))


def test_pixels_become_png() -> None:
    (rgb,) = pictures(recorded({"encoding": "rgb8", "width": 4, "height": 2}))
    assert rgb.name == "000001.png"
    assert pixels(rgb.data) == BODY
    (bgr,) = pictures(recorded({"encoding": "BGR8", "width": 2, "height": 4}))
    assert pixels(bgr.data)[:6] == bytes((2, 1, 0, 5, 4, 3))
    assert format_png(1, 1, b"abc").startswith(b"\x89PNG")


def test_files_stay_as_they_are() -> None:
    jpeg, png = b"\xff\xd8\xff" + bytes(21), b"\x89PNG\r\n\x1a\n" + bytes(16)
    found = pictures(
        recorded({"encoding": "jpeg"}, jpeg, 7),
        recorded({"encoding": "png"}, png, 8),
        recorded({"encoding": "png"}, jpeg, 9),
    )
    assert found == [
        Picture(0, "000007.jpg", jpeg),
        Picture(0, "000008.png", png),
    ]


@pytest.mark.parametrize(
    "metadata",
    [
        *({}, {"encoding": "h264"}, {"encoding": "rgb8"}, {"encoding": "rgb8", "width": 8}),
        {"encoding": "rgb8", "width": 4, "height": 3},
        {"encoding": "rgb8", "width": -4, "height": -2},
        {"encoding": "rgb8", "width": 4.0, "height": 2},
        {"encoding": ["rgb8"]},
    ],
)
def test_what_is_no_picture(metadata: dict[str, object]) -> None:
    assert pictures(recorded(metadata)) == []


def test_metadata_that_are_none() -> None:
    one = recorded({})
    long = json.dumps({"encoding": "rgb8", "width": 4, "height": 2, "x": "y" * 70_000}).encode()
    assert pictures(one._replace(meta=long)) == []
    for meta in (b"encoding", b'["encoding"]', b'"encoding' + b"[" * 50_000, b"[" * 50_000):
        assert pictures(one._replace(meta=meta + b"encoding")) == []


JPEG = "ffd8 ffe00004abcd ffc0000b080300050001"


@pytest.mark.parametrize(
    ("jpeg", "pixels"),
    [
        (JPEG, 0x0300 * 0x0500),
        (JPEG.replace("ffc0", "ffc2"), 0x0300 * 0x0500),
        (JPEG.replace("ffc0", "ffc4"), 0),
        (JPEG.replace("ffe00004", "ffe00001"), 0),
        (JPEG.replace("ffe0", "00e0"), 0),
        ("ffd8" + 2000 * "ffe00002" + "ffc0000b080300050001", 0),
        (JPEG[:-6], 0),
        ("", 0),
    ],
)
def test_the_pixels_that_a_jpeg_says_it_has(jpeg: str, pixels: int) -> None:
    assert pixels_of("jpg", bytes.fromhex(jpeg)) == pixels


def test_the_pixels_that_a_png_says_it_has() -> None:
    assert pixels_of("png", format_png(4, 2, BODY)) == 8
    assert pixels_of("png", b"\x89PNG\r\n\x1a\n") == 0


def test_the_last_ones_of_each_output() -> None:
    of_camera = {"encoding": "rgb8", "width": 4, "height": 2}
    found = pictures(*(recorded(of_camera, number=at) for at in range(50)))
    assert [one.name for one in found] == [f"{at:06}.png" for at in range(50 - MOST_EACH, 50)]


def test_fewer_of_each_if_many_outputs_have_some() -> None:
    of_camera = {"encoding": "rgb8", "width": 4, "height": 2}
    for outputs, most in ((25, 10), (100, 2), (256, 1)):
        found = pictures(
            *(
                recorded(of_camera, number=number)._replace(output=output)
                for output in range(outputs)
                for number in range(12)
            )
        )
        assert [(one.output, one.name) for one in found] == [
            (output, f"{number:06}.png")
            for output in range(outputs)
            for number in range(12 - most, 12)
        ]

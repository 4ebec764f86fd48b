"""The native protocol: what another reader of the specification finds is what was written."""

import re

from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.logs.fields import ExportReader, encode_entry, legal_name

NAMES = st.from_regex(r"[A-Z][A-Z0-9_]{0,63}", fullmatch=True)
VALUES = st.binary(max_size=100) | st.sampled_from([b"", b"\n", b"a\nb", b"\x00=\n\n", b"="])


def decode(data: bytes) -> list[tuple[str, bytes]]:
    """The protocol as its specification words it, apart from our own code."""
    fields = []
    while data:
        line, data = data.split(b"\n", 1)
        if b"=" in line:
            name, value = line.split(b"=", 1)
        else:
            name, size = line, int.from_bytes(data[:8], "little")
            value, end, data = data[8 : 8 + size], data[8 + size : 9 + size], data[9 + size :]
            assert end == b"\n"
        fields.append((name.decode(), value))
    return fields


@given(st.dictionaries(NAMES, VALUES))
def test_encode(fields: dict[str, bytes]) -> None:
    assert decode(encode_entry(fields)) == list(fields.items())


@given(st.text(max_size=80))
def test_text_and_numbers(text: str) -> None:
    encoded = decode(encode_entry({"A": text.encode("utf-8", "replace"), "B": 7}))
    assert encoded[1] == ("B", b"7")


@given(st.text(max_size=100), st.sampled_from(["DORA_", "DORA_FIELD_"]))
def test_legal_name(name: str, prefix: str) -> None:
    legal = legal_name(name, prefix)
    assert re.fullmatch(r"[A-Z][A-Z0-9_]{0,63}", legal)
    assert legal.startswith(prefix)


@given(
    st.lists(st.dictionaries(NAMES, VALUES, min_size=1, max_size=5), max_size=4),
    st.integers(1, 50),
)
def test_export_reader(entries: list[dict[str, bytes]], size: int) -> None:
    data = b"".join(encode_entry(entry) + b"\n" for entry in entries)
    reader = ExportReader()
    found = [
        entry
        for start in range(0, len(data), size)
        for entry in reader.feed(data[start : start + size])
    ]
    assert found == entries


def test_names_for_journald() -> None:
    assert legal_name("a b-ä.c", "DORA_") == "DORA_A_B_C"
    assert legal_name("", "DORA_") == "DORA_"
    assert legal_name("x" * 99, "DORA_") == "DORA_" + "X" * 59


def test_values() -> None:
    assert encode_entry({"A": "é\udcff", "B": 7, "C": b"\xfe"}) == b"A=\xc3\xa9\xff\nB=7\nC=\xfe\n"
    assert encode_entry({"A": "a\nb"}) == b"A\n\x03\0\0\0\0\0\0\0a\nb\n"


def test_names_and_repeated_fields_of_other_writers() -> None:
    found = ExportReader().feed(b"\n\nA=1\nA=2\n\xff=3\n\n")
    assert found == [{"A": b"2", "\ufffd": b"3"}]

"""What a member says of its files, and what the head makes of it."""

import json

import pytest

from dora_systemd.decisions.machines.programs import (
    differing,
    format_differing,
    format_digests,
    parse_digests,
)

ONE, OTHER = "a" * 64, "b" * 64


def test_only_files_that_both_have_can_differ() -> None:
    told = {"sink.py": ONE, "lib/a.py": ONE, "only/there.bin": ONE}
    there = parse_digests(format_digests(told))
    assert there == told
    assert differing({"sink.py": OTHER, "lib/a.py": ONE, "mine.py": ONE}, there) == ["sink.py"]


@pytest.mark.parametrize("path", ["/etc/shadow", "../x.py", "a/../../x.py", "a\0b"])
def test_no_file_elsewhere_is_read_for_a_member(path: str) -> None:
    assert parse_digests(json.dumps({path: ONE, "x.py": "short", "y.py": 5})) == {}


@pytest.mark.parametrize("text", ["", "[]", "5", "{"])
def test_another_text(text: str) -> None:
    with pytest.raises(ValueError):
        parse_digests(text)


def test_what_people_read() -> None:
    files = ["a.py", "b.py", "c.py", "d.py"]
    assert format_differing({"gpu": []}) == ""
    assert format_differing({"gpu": ["a.py"], "arm": files}) == (
        "machine gpu runs another a.py than the one here; "
        "machine arm runs another a.py, b.py, c.py and 1 more than the one here"
    )

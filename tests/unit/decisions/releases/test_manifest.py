"""What stands in release.json and in the first line of a parcel: other versions read them."""

import json
from typing import Any

import pytest

from dora_systemd.decisions.releases.entries import MOST_FILES, Stored
from dora_systemd.decisions.releases.manifest import (
    Manifest,
    format_manifest,
    is_revision,
    new_id,
    parse_manifest,
)
from dora_systemd.decisions.releases.parcel import (
    Parcel,
    format_parcel,
    format_wants,
    parse_parcel,
    total,
)
from dora_systemd.errors import DoraSystemdError, ExitCode

ID, DIGEST = "20261121T220012", "ab" * 32
FILES = {
    "b": Stored(3, True, DIGEST),
    "a": Stored(0, False, DIGEST, is_built=True),
    "l": Stored(target="b"),
    "m": Stored(target="b", is_built=True),
}
TEXT = f"""{{
 "id": "{ID}",
 "name": "robot",
 "uuid": "u",
 "dataflow": "d.yml",
 "source": "/srv",
 "user": "eve",
 "revision": "",
 "created_us": 7,
 "versions": {{
  "dora": "1"
 }},
 "files": {{
  "a": {{
   "size": 0,
   "executable": false,
   "sha256": "{DIGEST}",
   "built": true
  }},
  "b": {{
   "size": 3,
   "executable": true,
   "sha256": "{DIGEST}"
  }},
  "l": {{
   "link": "b"
  }},
  "m": {{
   "link": "b",
   "built": true
  }}
 }},
 "given": {{
  "nice": "3",
  "needs": [
   "a:/dev/cam"
  ]
 }},
 "schema": 1
}}
"""


GIVEN: dict[str, str | list[str]] = {"nice": "3", "needs": ["a:/dev/cam"]}


def test_the_text_of_a_manifest() -> None:
    one = Manifest(ID, "robot", "u", "d.yml", "/srv", "eve", "", 7, {"dora": "1"}, FILES, GIVEN)
    assert format_manifest(one) == TEXT
    found = parse_manifest(TEXT, "x")
    assert found == one
    built = {path: stored.is_built for path, stored in found.files.items()}
    assert built == {"a": True, "b": False, "l": False, "m": True}


def test_a_manifest_without_versions() -> None:
    value = json.loads(TEXT)
    del value["versions"]
    assert parse_manifest(json.dumps(value), "x").versions == {}


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 2},
        {"files": {"a": {}}},
        {"more": "x"},
        {"id": 1},
        {"created_us": True},
        {"given": {"nice": 3}},
    ],
)
def test_what_is_no_manifest(change: dict[str, Any]) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_manifest(json.dumps({**json.loads(TEXT), **change}), "/x y/release.json")
    error = caught.value
    assert error.message == "cannot use /x y/release.json: it does not describe a release"
    assert error.hint == "remove that release, or deploy again"
    assert error.code is ExitCode.BAD_INPUT


PARCEL = Parcel("robot", "/srv", "d.yml", ".", "", {"d.yml": Stored(3, False, DIGEST)}, "eve")


def test_the_first_line_of_a_parcel() -> None:
    head = '{"schema": 1, "name": "robot", "source": "/srv", "dataflow": "d.yml", "directory": "."'
    file = f'{{"size": 3, "executable": false, "sha256": "{DIGEST}"}}'
    line = f'{head}, "revision": "", "files": {{"d.yml": {file}}}, "owner": "eve"}}\n'
    assert format_parcel(PARCEL) == line.encode()
    assert parse_parcel(line.encode()) == PARCEL
    assert format_wants(iter((0, 2))) == '{"wants": [0, 2]}'
    assert total([*FILES.values()]) == 3


def line_with(**change: object) -> bytes:
    return json.dumps({**json.loads(format_parcel(PARCEL)), **change}).encode()


FILE = {"size": 3, "executable": False, "sha256": DIGEST}
NO_PROJECT = ("it does not describe a project", "use doractl deploy -H")
REFUSED: list[tuple[dict[str, object], tuple[str, str]]] = [
    ({"schema": 2}, ("it comes from another version of doractl", "install the same version")),
    ({"source": "x" * 4097}, NO_PROJECT),
    ({"revision": "xyz"}, NO_PROJECT),
    ({"files": {}}, NO_PROJECT),
    ({"files": {"d.yml": {**FILE, "sha256": "ab"}}}, ("a file has no digest", NO_PROJECT[1])),
    ({"files": {"d.yml": {**FILE, "sha256": ""}}}, ("a file has no digest", NO_PROJECT[1])),
    ({"files": {"d.yml": {**FILE, "size": -1}}}, ("a file has no size", NO_PROJECT[1])),
    ({"files": {"d.yml": FILE, "x": {**FILE, "size": 4}}}, ("a file has no size", NO_PROJECT[1])),
]


@pytest.mark.parametrize(("change", "words"), REFUSED)
def test_the_words_for_what_is_no_parcel(change: dict[str, object], words: tuple[str, str]) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_parcel(line_with(**change))
    reason, hint = words
    assert caught.value.message == f"cannot read a project from standard input: {reason}"
    assert (caught.value.hint, caught.value.code) == (hint, ExitCode.BAD_INPUT)


@pytest.mark.parametrize(
    "change",
    [
        *({"directory": None}, {"directory": "a/b"}, {"source": "x" * 4096}, {"source": ""}),
        *({"files": {"d.yml": {**FILE, "size": 0}}}, {"revision": "abcd+"}),
    ],
)
def test_what_is_a_parcel(change: dict[str, object]) -> None:
    assert parse_parcel(line_with(**change)).name == "robot"


def test_the_most_files_of_a_parcel() -> None:
    files = {f"{number}": FILE for number in range(MOST_FILES - 1)}
    assert len(parse_parcel(line_with(files={**files, "d.yml": FILE})).files) == MOST_FILES
    with pytest.raises(DoraSystemdError, match=r"cannot copy \.: the project has more than"):
        parse_parcel(line_with(files={**files, "d.yml": FILE, "x": FILE}))


@pytest.mark.parametrize(
    ("at_us", "revision", "known", "expected"),
    [
        (1_795_298_412_999_999, "", (), "20261121T220012"),
        (1_795_298_412_000_000, "abcd", (), "20261121T220012-abcd"),
        (0, "", (), "19700101T000000"),
        (1_795_298_412_000_000, "", ("20261121T220012",), "20261121T220013"),
        (1_795_298_412_000_000, "abcd", ("20261121T220012",), "20261121T220012-abcd"),
        (1_795_298_412_000_000, "ab12", ("20261121T220012-cd34",), "20261121T220013-ab12"),
        (0, "", ("20261121T220011", "20261231T235959-abcd"), "20270101T000000"),
    ],
)
def test_new_ids(at_us: int, revision: str, known: tuple[str, ...], expected: str) -> None:
    assert new_id(at_us, revision, frozenset(known)) == expected


@pytest.mark.parametrize(
    ("text", "is_one"),
    [
        *(("abcd", True), ("abcd+", True), ("0" * 64, True), ("abc", False), ("0" * 65, False)),
        *(("", False), ("ABCD", False), ("abcd++", False), ("abcd\n", False)),
    ],
)
def test_revisions(text: str, is_one: bool) -> None:
    assert is_revision(text) is is_one

"""What stands in release.json and in the first line of a parcel: other versions read them."""

import json
import posixpath
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.releases.manifest import (
    FILE,
    LINK,
    MOST_BYTES,
    MOST_FILES,
    Found,
    Manifest,
    Stored,
    check_amount,
    check_found,
    format_manifest,
    is_plain_path,
    is_revision,
    new_id,
    parse_manifest,
    settled,
    too_many,
    touched,
)
from dora_systemd.decisions.releases.parcel import (
    Parcel,
    format_parcel,
    format_wants,
    parse_parcel,
    total,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import shown

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


ONE_FILE = {"size": 3, "executable": False, "sha256": DIGEST}
NO_PROJECT = ("it does not describe a project", "use doractl deploy -H")
REFUSED: list[tuple[dict[str, object], tuple[str, str]]] = [
    ({"schema": 2}, ("it comes from another version of doractl", "install the same version")),
    ({"source": "x" * 4097}, NO_PROJECT),
    ({"revision": "xyz"}, NO_PROJECT),
    ({"files": {}}, NO_PROJECT),
    ({"files": {"d.yml": {**ONE_FILE, "sha256": "ab"}}}, ("a file has no digest", NO_PROJECT[1])),
    ({"files": {"d.yml": {**ONE_FILE, "sha256": ""}}}, ("a file has no digest", NO_PROJECT[1])),
    ({"files": {"d.yml": {**ONE_FILE, "size": -1}}}, ("a file has no size", NO_PROJECT[1])),
    (
        {"files": {"d.yml": ONE_FILE, "x": {**ONE_FILE, "size": 4}}},
        ("a file has no size", NO_PROJECT[1]),
    ),
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
        *({"files": {"d.yml": {**ONE_FILE, "size": 0}}}, {"revision": "abcd+"}),
    ],
)
def test_what_is_a_parcel(change: dict[str, object]) -> None:
    assert parse_parcel(line_with(**change)).name == "robot"


def test_the_most_files_of_a_parcel() -> None:
    files = {f"{number}": ONE_FILE for number in range(MOST_FILES - 1)}
    assert len(parse_parcel(line_with(files={**files, "d.yml": ONE_FILE})).files) == MOST_FILES
    with pytest.raises(DoraSystemdError, match=r"cannot copy \.: the project has more than"):
        parse_parcel(line_with(files={**files, "d.yml": ONE_FILE, "x": ONE_FILE}))


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


def refusal_of(found: Found) -> str:
    """Why no release can have it, or ""."""
    try:
        check_found(found)
    except DoraSystemdError as error:
        return error.message
    return ""


@pytest.mark.parametrize(
    "path",
    ["a.py", "dir/a.py", "é/日本.py", "-rf", "a b.py", "..a", ".env"],
)
def test_good_names(path: str) -> None:
    assert not refusal_of(Found(path, FILE))


@pytest.mark.parametrize(
    "path",
    [
        "",
        "/etc/x",
        "a//b",
        "../a",
        "a/../b",
        "./a",
        "a/",
        "new\nline",
        "\ud800",
        "\x1b[2J",
        "\udcff",
        "a" * 2000,
    ],
)
def test_bad_names(path: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        check_found(Found(path, FILE))
    assert caught.value.code is ExitCode.BAD_INPUT
    assert caught.value.message.isprintable()


@pytest.mark.parametrize(
    ("path", "target"),
    [("l", "a"), ("d/l", "../a"), ("d/e/l", "../../a/b"), ("l", "./d/a"), ("d/l", ".")],
)
def test_good_links(path: str, target: str) -> None:
    assert not refusal_of(Found(path, LINK, target=target))


@pytest.mark.parametrize(
    ("path", "target"),
    [
        *(("l", "/etc/shadow"), ("l", ".."), ("l", "../a"), ("d/l", "../../a"), ("l", "")),
        # d may be a link to elsewhere in the project, and then this leads out of it.
        *(("l", "d/../../a"), ("l", "d/.."), ("l", "a\nb"), ("l", "a" * 2000)),
    ],
)
def test_bad_links(path: str, target: str) -> None:
    with pytest.raises(DoraSystemdError, match="cannot copy"):
        check_found(Found(path, LINK, target=target))


PARTS = st.lists(st.sampled_from(["..", "a", "b", ".", ""]), min_size=1, max_size=6)


@given(PARTS, st.integers(0, 3))
def test_no_link_leads_out(parts: list[str], depth: int) -> None:
    path, target = "/".join(["d"] * depth + ["l"]), "/".join(parts)
    try:
        check_found(Found(path, LINK, target=target))
    except DoraSystemdError:
        return
    end = posixpath.normpath(posixpath.join("/top/tree", posixpath.dirname(path), target))
    assert end == "/top/tree" or end.startswith("/top/tree/")


@pytest.mark.parametrize("kind", ["socket", "device", "FIFO", "directory", "special file"])
def test_other_kinds(kind: str) -> None:
    with pytest.raises(DoraSystemdError, match=f"it is a {kind}"):
        check_found(Found("x", kind))


def test_amounts() -> None:
    found = [Found("small", FILE, 1), Found("large", FILE, MOST_BYTES - 1)]
    assert check_amount(found) == MOST_BYTES
    with pytest.raises(DoraSystemdError, match="cannot copy large"):
        check_amount([*found, Found("one", FILE, 1)])


def test_what_has_changed() -> None:
    old = {"a": Stored(1, False, "x"), "b": Stored(1, False, "y"), "c": Stored(target="a")}
    new = {"a": Stored(1, True, "x"), "b": Stored(1, False, "y"), "d": Stored(target="a")}
    assert touched(old, new) == {"added": ["d"], "changed": ["a"], "removed": ["c"]}


IGNORE = "remove it, or name it in .gitignore"
RELATIVE = "link to a file of the project by a relative path, or copy what it leads to"
OTHER = "link to a file of the project, or copy what it leads to"
OUTSIDE = "it links to /etc/shadow, an absolute path, which is outside of every release"
WORDS = (
    (Found("a\nb", FILE), "its name is not printable text", "rename it"),
    (Found("x", "socket"), "it is a socket", IGNORE),
    (Found("l", LINK, target="/etc/shadow"), OUTSIDE, RELATIVE),
    (Found("l", LINK, target="../a"), "it links to ../a, which is not in the project", OTHER),
    (Found("l", LINK, target="a/.."), "it links to a/.., with .. behind a name", OTHER),
    (Found("l", LINK, target="a\n"), "its target is not printable text", OTHER),
    (Found("l", LINK), "its target is not printable text", OTHER),
)


@pytest.mark.parametrize(("one", "reason", "hint"), WORDS)
def test_the_words_of_a_refusal(one: Found, reason: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        check_found(one)
    message = f"cannot copy {shown(one.path)}: {reason}"
    error = caught.value
    assert (error.message, error.hint, error.code) == (message, hint, ExitCode.BAD_INPUT)


@pytest.mark.parametrize("text", ["a" * 1024, "é" * 512, "a/" * 511 + "bb"])
def test_the_longest_names(text: str) -> None:
    check_found(Found(text, FILE))
    check_found(Found("l", LINK, target=text))
    assert is_plain_path(text)
    assert not is_plain_path(f"{text}x")


def test_the_longest_target() -> None:
    check_found(Found("l", LINK, target="é" * 1024))
    with pytest.raises(DoraSystemdError, match="its target is not printable text"):
        check_found(Found("l", LINK, target="é" * 1025))


@pytest.mark.parametrize(
    ("signature", "changed_ns", "at_s", "is_settled"),
    [
        ("7 4 5 33188", 10**9, 62, True),
        ("7 4 5 33188", 10**9, 61, False),
        ("7 4 5 33188", 10**9, 0, False),  # the clock was ahead
        ("7 4 33188", 10**9, 62, False),
        ("7 4 5 33188", -1, 62, False),
        ("7 4 5 33188", 10**20, 10**30, False),
        ("", 10**9, 62, False),
    ],
)
def test_only_an_old_time_says_that_a_file_is_the_same(
    signature: str, changed_ns: int, at_s: int, is_settled: bool
) -> None:
    one = Found("a", FILE, signature=signature, changed_ns=changed_ns)
    assert settled(one, at_s * 10**9) == (one.seen if is_settled else "")


def test_the_words_for_too_much() -> None:
    found = [Found("a", FILE, 1 << 30), Found("l", LINK, 1 << 40), Found("b", FILE, 4 << 30)]
    with pytest.raises(DoraSystemdError) as caught:
        check_amount(found)
    assert caught.value.message == "cannot copy b: the project has 5G, 4G of it here"
    hint = "a release has at most 4G: keep data elsewhere, or name it in .gitignore"
    assert caught.value.hint == hint
    assert check_amount(found[:2]) == 1 << 30
    many, top = too_many("data"), too_many("")
    assert many.message == "cannot copy data: the project has more than 100000 files"
    assert many.hint == "name directories of data in .gitignore"
    assert top.message.startswith("cannot copy .: ")

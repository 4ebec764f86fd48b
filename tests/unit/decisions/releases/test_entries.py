"""Which files a release can have: who owns the project chooses names, links and sizes."""

import posixpath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.releases.entries import (
    FILE,
    LINK,
    MOST_BYTES,
    Found,
    Stored,
    check_amount,
    check_found,
    is_plain_path,
    settled,
    too_many,
    touched,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import shown


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

"""Sizes, durations, CPU shares and booleans: there and back, and nothing but our error."""

import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import (
    INFINITY,
    format_bool,
    format_cpu,
    format_duration,
    format_rounded_size,
    format_size,
    parse_bool,
    parse_cpu,
    parse_duration,
    parse_size,
    quoted,
    shell_word,
    shown,
)

numbers = st.integers(0, INFINITY)


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("0", 0),
        ("512", 512),
        ("1K", 1024),
        ("512M", 512 * 1024**2),
        ("1.5G", 1536 * 1024**2),
        ("4 G", 4 * 1024**3),
        ("2T", 2 * 1024**4),
        ("infinity", INFINITY),
    ],
)
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize(
    ("text", "duration"),
    [
        ("10", 10_000_000),
        ("10s", 10_000_000),
        ("1min 30s", 90_000_000),
        ("1min30s", 90_000_000),
        ("500ms", 500_000),
        ("1.5h", 5_400_000_000),
        ("2 us", 2),
        ("1d", 86_400_000_000),
        ("0", 0),
        ("infinity", INFINITY),
    ],
)
def test_durations(text: str, duration: int) -> None:
    assert parse_duration(text) == duration


@pytest.mark.parametrize(
    ("text", "share"),
    [
        ("2.0", 2_000_000),
        ("150%", 1_500_000),
        ("0.5", 500_000),
        ("33.33%", 333_300),
        ("infinity", INFINITY),
    ],
)
def test_cpu_shares(text: str, share: int) -> None:
    assert parse_cpu(text) == share


@pytest.mark.parametrize("text", ["", "-1", "4 gigs", "4g", "1 2", "9" * 5000, "1e3", "٣", "20E"])
def test_bad_sizes(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot read .* as a size$") as caught:
        parse_size(text)
    assert caught.value.code == ExitCode.USAGE
    assert "512M" in caught.value.hint


@pytest.mark.parametrize("text", ["", "-1", "5 parsec", "s", "1s x", "999999999y", "1..2", "٣s"])
def test_bad_durations(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot read .* as a duration$"):
        parse_duration(text)


@pytest.mark.parametrize("text", ["", "0", "0%", "-1", "0.00001", "1,5", "two", "9" * 5000])
def test_bad_cpu_shares(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot read .* as a CPU share$"):
        parse_cpu(text)


def test_booleans() -> None:
    assert all(parse_bool(text) for text in ("yes", "True", "on", "1", "y"))
    assert not any(parse_bool(text) for text in ("no", "FALSE", "off", "0", "n"))
    with pytest.raises(DoraSystemdError):
        parse_bool("maybe")


@given(numbers)
def test_size_and_back(size: int) -> None:
    assert parse_size(format_size(size)) == size


@given(numbers)
def test_duration_and_back(duration: int) -> None:
    assert parse_duration(format_duration(duration)) == duration


@given(st.integers(1, 2**40).map(lambda step: step * 100) | st.just(INFINITY))
def test_cpu_share_and_back(share: int) -> None:
    assert parse_cpu(format_cpu(share)) == share


@given(st.booleans())
def test_boolean_and_back(value: bool) -> None:
    assert parse_bool(format_bool(value)) is value


@given(st.text() | st.from_regex(r"[0-9.]*\s?[A-Za-zµ%]{0,4}", fullmatch=True))
def test_garbage_is_refused_by_our_error(text: str) -> None:
    for parse in (parse_size, parse_duration, parse_cpu, parse_bool):
        try:
            parse(text)
        except DoraSystemdError as error:
            assert error.message.startswith("cannot")
            assert error.message.isprintable()


@pytest.mark.parametrize(
    ("size", "text"),
    [
        (0, "0B"),
        (1023, "1023B"),
        (1536, "1.5K"),
        (256 * 1024**2, "256M"),
        (4 * 1024**3, "4G"),
        (10 * 1024**3 + 1, "10G"),
        (INFINITY, "infinity"),
    ],
)
def test_rounded_sizes(size: int, text: str) -> None:
    assert format_rounded_size(size) == text


@given(numbers)
def test_rounded_sizes_are_short(size: int) -> None:
    assert len(format_rounded_size(size)) <= len("infinity")


@given(st.text(max_size=300))
def test_quoted_text_is_short_and_plain(text: str) -> None:
    assert quoted(text).isprintable()
    assert shown(text).isprintable()
    assert shown(text)


@pytest.mark.parametrize(
    "text", ["/home/a/x; touch /y", "/a $(id)", "it's `id`", "/a\nid", "'$(id)\x1b", "", "/a"]
)
def test_a_path_in_a_command_is_one_word_of_it(text: str) -> None:
    words = shlex.split(shell_word(text))
    assert words in ([text], [shown(text)])
    assert shell_word(text).isprintable()


def test_plain_paths_are_shown_as_they_are() -> None:
    assert shown("/home/x y/ü.yml") == "/home/x y/ü.yml"
    assert shown("/a\nb") == r"'/a\nb'"

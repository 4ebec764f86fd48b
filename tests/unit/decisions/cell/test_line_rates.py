"""Limits on a node's lines: their texts, whose they are, and what they take."""

from collections.abc import Mapping
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.line_rates import (
    ALL_NODES,
    SHORTEST,
    LineLimiter,
    RateLimit,
    RateLimits,
    check_rates,
    format_rate,
    parse_rate,
    rate_of,
    rate_texts,
    rates_of,
)
from dora_systemd.decisions.cell.options import format_setting
from dora_systemd.decisions.settings.resolve import Settings, resolve_settings, with_settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND
from tests.unit.fakes.dialogue import OPTIONS
from tests.unit.fakes.manager import with_texts

LIMIT = RateLimit(3, SECOND)
RATES = st.builds(RateLimit, st.integers(1, 10**18 - 1), st.integers(SHORTEST, INFINITY - 1))


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("1000/1s", RateLimit(1000, SECOND)),
        (" 5 / 500ms ", RateLimit(5, SECOND // 2)),
        ("1/1min 30s", RateLimit(1, 90 * SECOND)),
        ("10/2", RateLimit(10, 2 * SECOND)),
        ("infinity", None),
    ],
)
def test_parse(text: str, limit: RateLimit | None) -> None:
    assert parse_rate(text) == limit


@given(st.none() | RATES)
def test_text_and_back(limit: RateLimit | None) -> None:
    assert parse_rate(format_rate(limit)) == limit


BAD = ["", "1000", "0/1s", "-1/1s", "1.5/1s", "1000/", "/1s", "x/1s", "1/x", "1/0", "1/99ms"]
BAD += ["1/infinity", "1/1s/1s", "²/1s", "1" * 19 + "/1s"]


@pytest.mark.parametrize("text", BAD)
def test_bad_limits(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot read .* as a rate of lines$") as caught:
        parse_rate(text)
    assert "1000/1s" in caught.value.hint
    assert caught.value.code is ExitCode.USAGE


TEXTS = [
    *("log_rate_limit=1000/1s", "camera:log_rate_limit=5/1s", "lidar:log_rate_limit=infinity"),
]


def test_limits_of_nodes() -> None:
    limits = rates_of(with_texts(OPTIONS, *TEXTS))
    assert [format_setting(one) for one in rate_texts(limits)] == TEXTS
    assert rate_of(limits, "camera") == RateLimit(5, SECOND)
    assert rate_of(limits, "lidar") is None
    assert rate_of(limits, "other") == RateLimit(1000, SECOND)
    assert rate_of({}, "other") is None


def rates_of_settings(settings: Settings) -> RateLimits:
    return rates_of(with_settings(OPTIONS, settings))


def settings(flags: Mapping[str, object], document: object = None) -> Settings:
    return resolve_settings(flags, {}, [("/srv/robot.systemd.yml", document)])


def test_a_flag_for_a_node_wins_and_one_for_all_does_not() -> None:
    document = {
        "log_rate_limit": "9/1s",
        "nodes": {"camera": {"log_rate_limit": "5/1s"}, "lidar": {"log_rate_limit": "infinity"}},
    }
    flags = {"nodes": ("camera:log_rate_limit=1/1s",), "log_rate_limit": "8/1s"}
    assert rates_of_settings(settings(flags, document)) == {
        **{ALL_NODES: RateLimit(8, SECOND), "camera": RateLimit(1, SECOND), "lidar": None}
    }
    variables = {"DORA_LOG_RATE_LIMIT": "7/1s"}
    assert rates_of_settings(resolve_settings({}, variables, [])) == {
        ALL_NODES: RateLimit(7, SECOND)
    }


def test_a_limit_must_name_a_node_that_is_there() -> None:
    limits = {ALL_NODES: LIMIT, "camra": LIMIT}
    with pytest.raises(DoraSystemdError, match=r"^cannot limit the lines .*'camra'") as caught:
        check_rates(limits, ["camera", "lidar"])
    assert caught.value.hint == "did you mean camera?"
    with pytest.raises(DoraSystemdError) as caught:
        check_rates(limits, ["one", "two"])
    assert caught.value.hint == "nodes: one, two"
    check_rates(limits, ["camra"])


def test_window() -> None:
    limiter = LineLimiter(LIMIT)
    assert limiter.admit("stdout", 2, 10.0) == 2
    assert limiter.admit("stdout", 2, 10.5) == 1
    assert limiter.end("stdout") == 11.0
    assert limiter.admit("stdout", 5, 10.9) == 0
    assert limiter.take_suppressed() == 6
    assert limiter.take_suppressed() == 0
    assert limiter.admit("stdout", 5, 11.0) == 3
    assert limiter.take_suppressed() == 2


def test_a_flood_on_one_stream_leaves_the_other_alone() -> None:
    limiter = LineLimiter(LIMIT)
    assert limiter.admit("stdout", 100, 10.0) == 3
    assert limiter.admit("stderr", 3, 10.0) == 3
    assert limiter.suppressed == 97


STEPS = st.lists(
    st.tuples(st.sampled_from(["stdout", "stderr"]), st.integers(0, 9), st.floats(0.0, 0.7)),
    max_size=50,
)


@given(STEPS)
def test_any_history(steps: list[tuple[str, int, float]]) -> None:
    """Each line passes or is counted, and no window of any stream has more than its limit."""
    limiter, now = LineLimiter(LIMIT), 0.0
    passed: dict[tuple[str, float], int] = {}
    for stream, count, wait in steps:
        now += wait
        got = limiter.admit(stream, count, now)
        key = (stream, limiter.end(stream))
        passed[key] = passed.get(key, 0) + got
    assert all(count <= LIMIT.lines for count in passed.values())
    ends = sorted(passed)
    assert all(
        later - earlier > 0.999
        for (stream, earlier), (other, later) in pairwise(ends)
        if stream == other
    )
    assert sum(passed.values()) + limiter.suppressed == sum(count for _, count, _ in steps)

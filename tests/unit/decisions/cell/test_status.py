"""The node table in JSON, CPU percentages from its samples."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.exits import parse_exit
from dora_systemd.decisions.cell.status import (
    NODE_STATES,
    STAGES,
    CellStatus,
    NodeStatus,
    format_stopped,
    is_stopped,
    was_asked,
)
from dora_systemd.decisions.resources.usage import (
    CpuSample,
    LineCount,
    add_sample,
    cpu_percent,
    throttled_percent,
)
from dora_systemd.decisions.watchdog.messages import MAX_STATUS, Sign
from dora_systemd.errors import DoraSystemdError

counts = st.integers(0, 2**63 - 1)
times = st.integers(0, 2**56)
ids = st.from_regex(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,20}", fullmatch=True)
exits = st.builds(parse_exit, st.text() | st.sampled_from(["exit code 3", "signal SIGKILL"]))
nodes = st.builds(
    NodeStatus,
    *(st.sampled_from(NODE_STATES), counts, counts, times, exits, st.text()),
    max_restarts=counts,
    machine=st.sampled_from(["", "gpu"]),
)
samples = st.builds(
    CpuSample,
    counts,
    st.dictionaries(ids | st.just(""), counts),
    st.dictionaries(ids, st.tuples(counts, counts)),
)
cells = st.builds(
    CellStatus,
    *(st.text(), st.text(), st.sampled_from(STAGES), st.text(), times, times),
    st.dictionaries(ids, nodes),
    st.lists(samples, max_size=2).map(tuple),
    st.dictionaries(ids, st.builds(LineCount, counts, counts, counts)),
    *(counts, st.booleans()),
    st.dictionaries(ids, st.builds(Sign, st.text(max_size=MAX_STATUS), times, times)),
    st.dictionaries(ids, counts),
    st.dictionaries(ids, st.lists(st.none() | counts, max_size=3).map(tuple)),
    st.sampled_from(["", "0.1.0", "1.0~rc1+git-2"]),
    counts,
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(cells)
def test_json_and_back(cell: CellStatus) -> None:
    assert CellStatus.from_json(cell.to_json()) == cell


def test_keys_of_a_newer_runner_are_left_aside() -> None:
    raw = json.loads(CellStatus(uuid="u", nodes={"a": NodeStatus()}).to_json())
    raw["mood"] = "fine"
    raw["nodes"]["a"]["colour"] = "red"
    assert CellStatus.from_json(json.dumps(raw)).nodes["a"] == NodeStatus()


def test_missing_keys_have_defaults() -> None:
    assert CellStatus.from_json("{}") == CellStatus(version="")


@pytest.mark.parametrize("version", ["x", "1\n", "1" * 41, "1 2", "\u0661", 1])
def test_a_version_that_cannot_be(version: object) -> None:
    with pytest.raises(DoraSystemdError, match="its version is"):
        CellStatus.from_json(json.dumps({"version": version}))


@given(json_values)
def test_any_json_is_a_table_or_an_error(value: Any) -> None:
    for text in (
        json.dumps(value),
        json.dumps({"nodes": value}),
        json.dumps({"samples": value}),
        json.dumps({"samples": [{"at_us": 1, "throttling": value, "cpu_us": value}]}),
        json.dumps({"lines": value, "stage": value}),
        json.dumps({"up_us": value, "is_first": value}),
        json.dumps({"nodes": {"a": {"pid": value, "state": value}}}),
    ):
        try:
            CellStatus.from_json(text)
        except DoraSystemdError as error:
            assert error.message.startswith("cannot")


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '{"nodes": []}', '{"nodes": {"a": 1}}'])
def test_no_table(text: str) -> None:
    with pytest.raises(DoraSystemdError):
        CellStatus.from_json(text)


@pytest.mark.parametrize(
    "text",
    [
        '{"started_us": Infinity}',
        '{"ready_us": NaN}',
        '{"samples": [{"at_us": -Infinity}]}',
        '{"nodes": {"a": {"restarts": 1e999}}}',
        '{"nodes": {"a": {"pid": "7"}}}',
        '{"nodes": {"a": {"pid": true}}}',
        '{"nodes": {"a": {"restarts": -1}}}',
        '{"nodes": {"a": {"since_us": 99999999999999999999}}}',
        '{"nodes": {"a": {"since_us": 1' + "0" * 5000 + "}}}",
        '{"nodes": {"a": {"since_us": 253402300800000000}}}',
        '{"nodes": {"a": {"state": "on fire"}}}',
        '{"nodes": {"a": {"exit": ["x"]}}}',
        '{"nodes": {"a\\u001b]0;pwned\\u0007": {}}}',
        '{"nodes": {"a b": {}}}',
        '{"nodes": {"": {}}}',
        '{"nodes": {"../a": {}}}',
        '{"samples": [{"at_us": 1, "cpu_us": {"a\\nb": 1}}]}',
        '{"lines": {"a": [1, 2]}}',
        '{"lines": {"a": "123"}}',
        '{"stage": "weird"}',
        '{"text": 7}',
        "[" * 100_000,
        '{"nodes":' * 100_000,
        json.dumps({"nodes": {f"n{one}": {} for one in range(3000)}}),
        json.dumps({"samples": [{"at_us": 1}] * 9}),
    ],
)
def test_what_no_runner_writes_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        CellStatus.from_json(text)
    assert caught.value.message.isprintable()
    assert len(caught.value.message) < 100


def test_a_long_text_is_cut() -> None:
    node = CellStatus.from_json(json.dumps({"nodes": {"a": {"exit": "x" * 10**6}}})).nodes["a"]
    assert len(str(node.exit)) == 1000


def test_counts() -> None:
    table = {
        "a": NodeStatus("running", restarts=2),
        "b": NodeStatus("failed", restarts=1),
        "c": NodeStatus("dynamic"),
    }
    cell = CellStatus(nodes=table)
    assert cell.alive_count == 2


def test_throttled_percent() -> None:
    """Of the periods in which the node wanted to run, those in which it had to wait."""
    old = (CpuSample(0, {}, {"a": (100, 90)}),)
    assert throttled_percent(old, CpuSample(5 * SECOND, {}, {"a": (150, 110)}), "a") == 40.0
    assert throttled_percent(old, CpuSample(5 * SECOND, {}, {"a": (100, 90)}), "a") == 0.0
    assert throttled_percent((), CpuSample(5 * SECOND, {}, {"a": (10, 1)}), "a") == 10.0
    assert throttled_percent(old, CpuSample(5 * SECOND), "b") == 0.0


def test_only_the_last_samples_are_kept() -> None:
    one, two, three = (CpuSample(at) for at in (1, 2, 3))
    assert add_sample(add_sample(add_sample((), one), two), three) == (two, three)


SECOND = 1_000_000


@pytest.mark.parametrize(
    ("base", "now", "percent"),
    [
        ((), CpuSample(10 * SECOND, {"": 5 * SECOND}), 50.0),
        ((CpuSample(0, {"": 0}),), CpuSample(SECOND, {"": SECOND // 4}), 25.0),
        # The newest sample that is old enough.
        (
            (CpuSample(0, {"": 0}), CpuSample(5 * SECOND, {"": SECOND})),
            CpuSample(7 * SECOND, {"": 3 * SECOND}),
            100.0,
        ),
        # A sample of this moment tells nothing.
        (
            (CpuSample(0, {"": 0}), CpuSample(5 * SECOND, {"": 5 * SECOND})),
            CpuSample(5 * SECOND + 10, {"": 5 * SECOND}),
            pytest.approx(100.0, rel=0.01),
        ),
        # The group was made anew.
        ((CpuSample(0, {"": SECOND}),), CpuSample(SECOND, {"": 0}), 0.0),
        # The clock stood still.
        ((CpuSample(SECOND, {"": 0}),), CpuSample(SECOND, {"": SECOND}), 0.0),
    ],
)
def test_cpu_percent(base: tuple[CpuSample, ...], now: CpuSample, percent: float) -> None:
    assert cpu_percent(base, now) == percent


def test_a_node_that_came_later_had_used_nothing() -> None:
    base = (CpuSample(0, {"": SECOND}),)
    assert cpu_percent(base, CpuSample(SECOND, {"late": SECOND}), "late") == 100.0


ROOT, PAGE = "root (doractl node stop)", "root (status page)"


@pytest.mark.parametrize("state", NODE_STATES)
@pytest.mark.parametrize("asked", ["", "restart", "stop"])
def test_whether_an_end_was_asked_for(state: str, asked: str) -> None:
    """Every pair: a stop covers all ends, a restart the one process that it ends."""
    node = NodeStatus(state, asked=asked)
    assert was_asked(node) == (asked == "stop" or (asked, state) == ("restart", "reloading"))
    assert is_stopped(node) == (asked == "stop")


@pytest.mark.parametrize(
    ("stopped", "text"),
    [
        ({}, ""),
        ({"a": ""}, ""),
        ({"a": ROOT, "b": "", "c": ROOT}, f"a, c, requested by {ROOT}"),
        ({"a": ROOT, "b": PAGE}, f"a, requested by {ROOT}; b, requested by {PAGE}"),
    ],
)
def test_who_has_stopped_what(stopped: dict[str, str], text: str) -> None:
    assert format_stopped(stopped) == text

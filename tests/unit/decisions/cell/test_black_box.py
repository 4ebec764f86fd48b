"""The setting black_box: its values, and which bundles stay."""

import pytest

from dora_systemd.decisions.cell.black_box import (
    AFTER_BOOT,
    QUIET,
    BlackBox,
    Past,
    format_black_box,
    is_after_boot,
    is_too_soon,
    parse_black_box,
    to_remove,
)
from dora_systemd.decisions.settings.on_failure import BLACK_BOX
from dora_systemd.errors import DoraSystemdError, ExitCode
from tests.unit.fakes.manager import options, with_texts


@pytest.mark.parametrize(
    ("text", "box"),
    [
        *(("yes", BlackBox()), ("no", None), ("keep=2", BlackBox(2))),
        ("keep=3, size=30M", BlackBox(3, 30 << 20)),
        ("size=5M", BlackBox(5, 5 << 20)),
    ],
)
def test_values(text: str, box: BlackBox | None) -> None:
    assert parse_black_box(text) == box
    assert parse_black_box(format_black_box(box)) == box


def test_a_mapping_of_a_settings_file() -> None:
    box = BLACK_BOX.kind.parse({"keep": 2, "size": "8M"}, None)
    assert box == BlackBox(2, 8 << 20)
    assert BLACK_BOX.kind.format(box) == ["keep=2,size=8M"]
    assert BLACK_BOX.kind.format(BLACK_BOX.kind.parse(False, None)) == ["no"]
    assert box
    assert box.most == 4 << 20


@pytest.mark.parametrize(
    "text",
    [
        *("", "maybe", "keep=", "keep=0", "keep=-1", "keep=101", "keep=x", "keep=\u0662"),
        *("size=x", "size=4M", "size=infinity", "keep=5,size=1M", "other=1", "keep=1,=2"),
    ],
)
def test_bad_values(text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_black_box(text)
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.hint


def test_a_power_cut_is_looked_for_after_a_boot() -> None:
    assert is_after_boot(BlackBox(), AFTER_BOOT - 1)
    assert not is_after_boot(BlackBox(), AFTER_BOOT)
    assert not is_after_boot(None, 0)


def past(*events: str) -> list[Past]:
    return [Past(f"{place}", event, place) for place, event in enumerate(events)]


def test_the_oldest_of_the_most_frequent_event_goes() -> None:
    assert to_remove(past("rolled-back", "failed", "failed"), 4) == []
    assert to_remove(past("rolled-back", "failed", "failed"), 3) == ["1"]
    assert to_remove(past("failed", "rolled-back"), 2) == ["0"]
    assert to_remove(past("rolled-back", "failed", "failed"), 1) == ["1", "0", "2"]


def test_one_of_the_same_node_and_cause_within_ten_minutes() -> None:
    known = [Past("x", "failed", 1000, "camera", "node-failed")]
    assert is_too_soon(known, "camera", "node-failed", 1000 + QUIET - 1)
    assert not is_too_soon(known, "camera", "node-failed", 1000 + QUIET)
    assert not is_too_soon(known, "arm", "node-failed", 1001)
    assert not is_too_soon(known, "camera", "node-hung", 1001)
    assert not is_too_soon(known, "camera", "node-failed", 999)


def test_it_alone_is_followed_by_something() -> None:
    assert not options().is_noticed
    assert with_texts(options(), "black_box=yes").is_noticed
    assert not with_texts(options(), "black_box=no").is_noticed
    assert with_texts(options(), "on_failure=/bin/true").is_noticed

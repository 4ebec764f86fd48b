"""Ids, manifests, which releases stay, and which one a rollback takes."""

import json

import pytest

from dora_systemd.decisions.releases.manifest import (
    Manifest,
    Stored,
    format_manifest,
    is_revision,
    new_id,
    parse_manifest,
)
from dora_systemd.decisions.releases.past import (
    REPLACED,
    ROLLED_BACK,
    Known,
    Switch,
    before,
    state_of,
    surplus,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import is_release_id, release_of

MOMENT = 1_795_298_412_000_000
DAYS = [f"2026112{day}T220012" for day in range(7)]
KNOWN = [Known(one, place not in (3, 5)) for place, one in enumerate(DAYS)]


def test_ids() -> None:
    plain = new_id(MOMENT, "", frozenset())
    assert is_release_id(plain)
    assert new_id(MOMENT, "9f3c1a2+", frozenset()) == f"{plain}-9f3c1a2+"
    second = new_id(MOMENT, "", frozenset({plain}))
    assert is_release_id(second)
    assert second > plain
    ahead = f"{plain}-ffff.10"
    for revision in ("", "0000", "9f3c1a2+"):  # the clock was ahead, or goes back
        third = new_id(MOMENT - 10**12, revision, frozenset({plain, second, ahead}))
        assert is_release_id(third)
        assert third > max(second, ahead)
    assert is_revision("9f3c1a2+")
    assert not is_revision("$(id)")
    for text in ("", "..", f"{plain}/x", f".new-{plain}", f"{plain}-xyz", f"{plain}\n"):
        assert not is_release_id(text)


def test_the_path_has_the_release() -> None:
    place = f"dora-systemd/releases/robot/{DAYS[0]}-9f3c1a2+/tree/flows/a.yml"
    assert release_of(f"/var/lib/{place}") == f"{DAYS[0]}-9f3c1a2+"
    assert release_of(f"/home/a/.local/state/{place}") == f"{DAYS[0]}-9f3c1a2+"
    assert release_of("/srv/robot/dataflow.yml") == ""
    assert release_of(f"/var/lib/dora-systemd/releases/robot/{DAYS[0]}/other/a.yml") == ""


def test_what_a_rollback_takes() -> None:
    assert before(KNOWN, DAYS[6]) == DAYS[4]
    assert before(KNOWN, DAYS[4]) == DAYS[2]
    assert before(KNOWN, DAYS[0]) == ""
    assert before(KNOWN, "") == DAYS[6]
    assert before([], "") == ""


@pytest.mark.parametrize("keep", [1, 2, 5, 9])
@pytest.mark.parametrize("current", DAYS)
def test_what_stays(keep: int, current: str) -> None:
    gone = surplus(KNOWN, keep, current, {DAYS[1], ""})
    left = [one for one in DAYS if one not in gone]
    assert {current, DAYS[1], before(KNOWN, current)} - {""} <= {*left}
    ran_well = [one.id for one in KNOWN if one.is_proved]
    assert {*ran_well[-keep:]} <= {*left}, "what has failed goes before it"
    assert len(left) <= keep + 3


def test_states() -> None:
    states = [state_of(one, DAYS[4], DAYS[6]) for one in KNOWN[3:]]
    assert states == ["unproved", "current", "unproved", "trial"]
    assert state_of(KNOWN[0], DAYS[4], "") == "proved"


MANIFEST = Manifest(
    *(DAYS[0], "robot", "u-u", "dataflow.yml", "/srv/robot", "eve", "9f3c1a2", MOMENT),
    versions={"dora-systemd": "1"},
    files={"a\udcff": Stored(3, True, "ab"), "l": Stored(target="a"), "e": Stored(0, False, "x")},
)


def test_manifests() -> None:
    text = format_manifest(MANIFEST)
    assert text.isascii()
    assert parse_manifest(text, "x") == MANIFEST
    assert MANIFEST.size == 3


def test_texts_that_are_no_texts() -> None:
    for key in ("uuid", "revision", "created_us"):
        value = {**json.loads(format_manifest(MANIFEST)), key: None}
        with pytest.raises(DoraSystemdError, match="does not describe a release"):
            parse_manifest(json.dumps(value), "/x/release.json")


@pytest.mark.parametrize("text", ["", "{}", "[]", "null", '{"schema": 1}', "[" * 100_000])
def test_bad_manifests(text: str) -> None:
    with pytest.raises(DoraSystemdError, match="does not describe a release"):
        parse_manifest(text, "/x/release.json")


@pytest.mark.parametrize(
    ("keep", "used", "gone"),
    [
        # 3 and 5 have not run well; 4 is before the present one, which is 6.
        (1, (), [0, 1, 2, 3, 5]),
        (2, (), [0, 1, 2, 3, 5]),
        (3, (), [0, 1, 3, 5]),
        (5, (), [3, 5]),
        (6, (), [3]),
        (7, (), []),
        (1, (0, 5), [1, 2, 3]),
    ],
)
def test_which_releases_go(keep: int, used: tuple[int, ...], gone: list[int]) -> None:
    found = surplus(KNOWN, keep, DAYS[6], [DAYS[one] for one in used])
    assert found == [DAYS[one] for one in gone]
    assert surplus(KNOWN[::-1], keep, DAYS[6], [DAYS[one] for one in used]) == found


def test_a_release_that_was_rolled_back_from_goes_before_older_ones() -> None:
    past = [
        Switch(0, "", DAYS[0], REPLACED),
        Switch(0, DAYS[0], DAYS[1], REPLACED),
        Switch(0, DAYS[1], DAYS[2], REPLACED),
        Switch(0, DAYS[2], DAYS[1], ROLLED_BACK),
    ]
    assert surplus(KNOWN[:3], 2, DAYS[1], (), past) == [DAYS[2]]
    assert state_of(KNOWN[2], DAYS[1], "", past[-1]) == ROLLED_BACK
    assert before(KNOWN[:3], DAYS[1], past) == DAYS[0]

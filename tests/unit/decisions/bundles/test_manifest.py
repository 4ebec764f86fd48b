"""The manifest of a bundle, also one that somebody else has written."""

import json
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.bundles.manifest import (
    MOST_LETTERS,
    MOST_PARTS,
    SCHEMA,
    Manifest,
    Part,
    directory_names,
    format_manifest,
    is_part_name,
    parse_manifest,
)
from dora_systemd.decisions.bundles.readme import ANNOUNCEMENT, format_readme
from dora_systemd.decisions.bundles.table import BundleRow, bundle_object, format_bundles
from dora_systemd.errors import DoraSystemdError, ExitCode

ONE = Manifest(
    *("robot", "u-u-i-d", "dora-robot.service", "system", "arm-3", 1_767_225_600_000_000),
    by="root (doractl bundle)",
    node="camera",
    cause="node-failed",
    summary="node camera: exit code 1",
    versions={"doractl": "0.1.0", "dora": None},
    left_out=("recording.mcap: nothing was recorded",),
    parts=(Part("README.txt", 5, "0" * 64), Part("stacks/camera.txt", 7, "a" * 64)),
)


def test_there_and_back() -> None:
    known = replace(ONE, state="Failed")
    assert parse_manifest(format_manifest(known).encode(), "x.tar") == known
    values = json.loads(format_manifest(known))
    del values["state"]
    assert parse_manifest(json.dumps(values).encode(), "x.tar") == ONE


@pytest.mark.parametrize("text", ["", "[]", "{", '{"kind": "x"}', "[" * 100_000, "\xff"])
def test_something_else(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"cannot read x\.tar as a bundle: its") as caught:
        parse_manifest(text.encode("latin-1"), "x.tar")
    assert caught.value.code is ExitCode.BAD_INPUT
    assert "\n" not in caught.value.message


def test_a_newer_one() -> None:
    values = {"kind": json.loads(format_manifest(ONE))["kind"], "schema": SCHEMA + 1}
    with pytest.raises(DoraSystemdError, match="a newer doractl has written it"):
        parse_manifest(json.dumps(values).encode(), "x.tar")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("name", 1), ("at_us", -1), ("at_us", True), ("parts", {}), ("parts", [[]])),
        ("parts", [{"name": "../x", "size": 1, "digest": "0" * 64}]),
        ("parts", [{"name": "x", "size": 1, "digest": "0"}]),
        ("parts", [{"name": "x", "size": 2**70, "digest": "0" * 64}]),
        ("parts", [{"name": "x", "size": 1, "digest": "0" * 64}] * (MOST_PARTS + 1)),
        *(("left_out", [1]), ("versions", {"x": 1})),
    ],
)
def test_wrong_values(key: str, value: Any) -> None:
    values = {**json.loads(format_manifest(ONE)), key: value}
    if key == "parts" and not value:
        values["parts"] = [value]
    with pytest.raises(DoraSystemdError, match="wrong values"):
        parse_manifest(json.dumps(values).encode(), "x.tar")


def test_names_of_parts() -> None:
    for name in (
        "README.txt",
        "stacks/camera-1.txt",
        "recording.mcap",
        "images/camera-image/1.png",
    ):
        assert is_part_name(name)
    for name in ("", "/etc/x", "../x", "a/../b", ".hidden", "a/.b/c", "a/b/c/d", "a\nb", "a/"):
        assert not is_part_name(name)
    for name in ("ü", "x" * 101, f"{'x' * 91}/y"):
        assert not is_part_name(name)


@given(st.lists(st.text(max_size=120), max_size=20))
def test_names_of_directories(texts: list[str]) -> None:
    names = directory_names(texts)
    assert len(names) == len(texts) == len({*names})
    assert all(is_part_name(f"images/{name}/1.png") for name in names)
    again = [name for name in names if len(name) <= MOST_LETTERS]
    assert directory_names(again) == again == names


def test_a_directory_has_the_name_of_what_is_in_it() -> None:
    found = directory_names(["camera/image", "camera-image", ".x", "", "ü", "x" * 99])
    assert found == ["camera-image", "camera-image-1", "-x", "-1", "-", "x" * 84 + "-1"]


def test_the_readme_announces_what_nodes_have_written() -> None:
    text = format_readme(ONE, "robot: Failed", ["why.json", "stacks/camera.txt"], True)
    assert text.startswith("Bundle of dataflow robot on arm-3, 2026-01-01T00:00:00")
    assert "\n\nrobot: Failed\n\n" in text
    assert ANNOUNCEMENT in text
    assert "stacks/" in text
    assert "unit.txt" not in text
    assert "was Running" not in text
    failed = replace(ONE, event="failed", state="Running")
    assert "the dataflow was Running." in format_readme(failed, "robot: Failed", [], True)
    without = format_readme(ONE, "robot: Failed", ["why.json"], False)
    assert ANNOUNCEMENT not in without
    assert "--no-journal" in without


def test_the_table() -> None:
    row = BundleRow("robot", "robot-1.tar", "/x/robot-1.tar", "requested", 2048, ONE)
    broken = row._replace(manifest=None)
    title, first, second = format_bundles([row, broken]).splitlines()
    assert title.split() == ["NAME", "BUNDLE", "WRITTEN", "EVENT", "SIZE", "WHY"]
    assert first.endswith("requested  2K    node camera: exit code 1")
    assert second.endswith("it cannot be read")
    found = bundle_object(row)
    assert (found["at_us"], found["cause"], found["size_bytes"]) == (ONE.at_us, ONE.cause, 2048)
    assert found.keys() == bundle_object(broken).keys()
    assert bundle_object(row._replace(manifest=replace(ONE, node="")))["node"] is None


@pytest.mark.parametrize("width", [60, 80])
def test_the_table_fits_a_narrow_terminal(width: int) -> None:
    """The name of a bundle has its time and event, too."""
    row = BundleRow("robot", "robot-20261128T030316Z-requested.tar", "/x", "requested", 2048, ONE)
    title, line = format_bundles([row], width).splitlines()
    assert title.split() == ["NAME", "BUNDLE", "WHY"]
    assert row.id in line
    assert len(line) <= width


@pytest.mark.parametrize(
    ("manifest", "words"),
    [
        (replace(ONE, cause="", state="Stopped"), "Stopped; requested by root (doractl bundle)"),
        (replace(ONE, cause="", by=""), "-"),
        (replace(ONE, cause="", event="machine-lost"), "node camera: exit code 1"),
        (replace(ONE, cause="", event="machine-lost", summary=""), "-"),
    ],
)
def test_a_stop_is_no_failure(manifest: Manifest, words: str) -> None:
    row = BundleRow("robot", "robot-1.tar", "/x/robot-1.tar", "requested", 2048, manifest)
    assert format_bundles([row]).splitlines()[1].endswith(f"  {words}")
    assert bundle_object(row)["cause"] is None

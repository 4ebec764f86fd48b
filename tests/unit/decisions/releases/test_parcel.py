"""What comes from another host is believed only if it can be a project."""

import json
from typing import Any

import pytest

from dora_systemd.decisions.releases.manifest import Stored
from dora_systemd.decisions.releases.parcel import (
    Parcel,
    format_parcel,
    missing,
    parse_parcel,
    parse_wants,
)
from dora_systemd.errors import DoraSystemdError

A, B = Stored(1, False, "a" * 64), Stored(2, True, "b" * 64)
FILES = {"dataflow.yml": A, "bin/run": B, "copy": A, "link": Stored(target="bin/run")}
PARCEL = Parcel("robot", "/srv/robot", "dataflow.yml", None, "9f3c1a2+", FILES, "ann")


def test_what_arrives_is_what_was_sent() -> None:
    assert parse_parcel(format_parcel(PARCEL)) == PARCEL


def test_only_what_is_missing_is_asked_for() -> None:
    assert PARCEL.contents == [A, B]
    assert missing(PARCEL, {}) == [0, 1]
    assert missing(PARCEL, {"other": B}) == [0]
    assert parse_wants({"wants": [1]}, PARCEL) == [B]
    for wrong in (None, {}, {"wants": 1}, {"wants": [2]}, {"wants": [True]}, {"wants": [0, 0]}):
        assert parse_wants(wrong, PARCEL) is None


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 2},
        {"name": "../x"},
        {"name": 1},
        {"dataflow": "gone.yml"},
        {"directory": ".."},
        {"directory": "/etc"},
        {"revision": "; rm"},
        {"source": None},
        {"owner": 1000},
        {"owner": "a\nb"},
        {"source": "a\nb"},
        {"files": {"x": {"size": float("inf"), "executable": False, "sha256": "a" * 64}}},
        {"files": []},
        {"more": 1},
        {"files": {"../x": {"size": 1, "executable": False, "sha256": "a" * 64}}},
        {"files": {"x": {"size": -1, "executable": False, "sha256": "a" * 64}}},
        {"files": {"x": {"size": 1 << 50, "executable": False, "sha256": "a" * 64}}},
        {"files": {"x": {"size": 2, "executable": False, "sha256": "a" * 64}}},
        {"files": {"x": {"size": 1, "executable": False, "sha256": "../a"}}},
        {"files": {"x": {"link": "/etc"}}},
        {"files": {"x": {"link": "../../y"}}},
    ],
)
def test_what_is_refused(change: dict[str, Any]) -> None:
    value = json.loads(format_parcel(PARCEL))
    files = {**value["files"], **change["files"]} if isinstance(change.get("files"), dict) else None
    value |= change | ({} if files is None else {"files": files})
    with pytest.raises(DoraSystemdError):
        parse_parcel(json.dumps(value).encode())


@pytest.mark.parametrize("line", [b"", b"[]", b"\xff", b"{", b"[" * 100_000, b'{"schema": 1}'])
def test_what_is_no_project(line: bytes) -> None:
    with pytest.raises(DoraSystemdError, match="cannot read a project from standard input"):
        parse_parcel(line)

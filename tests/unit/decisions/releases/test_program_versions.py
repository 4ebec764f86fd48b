"""The versions that a check tells, by a user's programs."""

import pytest

from dora_systemd.decisions.releases.manifest import Manifest, format_manifest, parse_manifest
from dora_systemd.decisions.releases.program_versions import format_versions, parse_versions
from dora_systemd.decisions.views.releases import ReleaseRow, format_releases, release_object
from dora_systemd.errors import DoraSystemdError

KNOWN = {"dora": "1.1.0", "python": "3.13.5"}


def test_back_and_forth() -> None:
    assert format_versions({**KNOWN, "other": "1"}) == "versions: dora=1.1.0 python=3.13.5"
    assert parse_versions(f"words\n{format_versions(KNOWN)}\n") == KNOWN
    assert parse_versions(format_versions({"dora": "1.1.0-rc.1", "python": ""})) == {
        "dora": "1.1.0-rc.1"
    }


@pytest.mark.parametrize(
    "text",
    [
        *("", "versions:", "versions: dora", "versions: dora=", "versions: dora=x", "dora=1.1.0"),
        *("versions: other=1", "versions: dora=1\x1b[2J", f"versions: dora={'1' * 40}"),
        "versions: dora=1/../../etc",
    ],
)
def test_what_is_no_version(text: str) -> None:
    assert parse_versions(text) == {}


def row(**versions: str) -> ReleaseRow:
    one = Manifest("20261121T220012", "robot", "u", "d.yml", "/srv", "", "", 1, versions, {})
    return ReleaseRow("robot", one.id, "current", "/x", one)


def test_they_are_listed() -> None:
    header, line = format_releases([row(**KNOWN)]).splitlines()
    assert header.split()[-2:] == ["DORA", "PYTHON"]
    assert line.split()[-2:] == ["1.1.0", "3.13.5"]
    assert format_releases([row()]).split()[-2:] == ["-", "-"]
    assert "DORA" not in format_releases([row(**KNOWN)], width=60)
    assert release_object(row(**KNOWN))["versions"] == KNOWN


@pytest.mark.parametrize("versions", ["3", "[1]", '"x"', "null"])
def test_a_manifest_with_other_things_in_their_place(versions: str) -> None:
    text = format_manifest(row().manifest or pytest.fail()).replace("{}", versions, 1)
    with pytest.raises(DoraSystemdError, match="does not describe a release"):
        parse_manifest(text, "/x")

"""The table of releases, and where else a release is shown."""

from dora_systemd.decisions.releases.manifest import Manifest, Stored
from dora_systemd.decisions.views.dataflows import format_dataflows
from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.prometheus import format_metrics
from dora_systemd.decisions.views.releases import ReleaseRow, format_releases, release_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.snapshot import Observed

ONE = "20261121T220012-9f3c1a2"
PLACE = f"/var/lib/dora-systemd/releases/robot/{ONE}/tree"
MANIFEST = Manifest(
    *(ONE, "robot", "u-u-i-d", "dataflow.yml", "/srv/robot", "", "9f3c1a2", 1_000_000),
    versions={"dora": "1.1.0"},
    files={"a": Stored(2048, False, "x"), "l": Stored(target="a")},
)
ROWS = [
    ReleaseRow("robot", ONE, "current", PLACE, MANIFEST),
    ReleaseRow("robot", "20261120T220012", "proved", "/x", None),
]


def test_the_table() -> None:
    title, first, second = format_releases(ROWS).splitlines()
    assert title.split() == ["NAME", "ID", "STATE", "CREATED", "SIZE", "FILES", "DORA", "PYTHON"]
    assert first.split()[:3] == ["robot", ONE, "current"]
    assert first.split()[-4:] == ["2K", "2", "1.1.0", "-"]
    assert second.split() == ["robot", "20261120T220012", "proved", *"-----"]


def test_a_narrow_terminal() -> None:
    lines = format_releases(ROWS, 60).splitlines()
    assert max(map(len, lines)) <= 60
    assert ONE in lines[1]


def test_the_object() -> None:
    found = release_object(ROWS[0])
    assert (found["size_bytes"], found["files"], found["user"]) == (2048, 2, None)
    assert found.keys() == release_object(ROWS[1]).keys()


def test_a_deployed_dataflow() -> None:
    row = DataflowRow("u" * 36, "robot", "dora-robot.service", "Running", f"{PLACE}/dataflow.yml")
    other = row._replace(name="other", dataflow="/srv/other.yml")
    assert "RELEASE" not in format_dataflows([other])
    title, first, second = format_dataflows([row, other]).splitlines()
    assert (title.split()[-1], first.split()[-1], second.split()[-1]) == ("RELEASE", ONE, "-")
    assert f"Release:  {ONE}" in format_dataflow(row)
    assert (dataflow_object(row)["release"], dataflow_object(other)["release"]) == (ONE, None)
    assert f'release="{ONE}"' in format_metrics([Observed(row)], "1")
    assert "release=" not in format_metrics([Observed(other)], "1")

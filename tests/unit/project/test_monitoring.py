"""Files for Prometheus, Grafana and log shippers: they name metrics and fields that exist."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from configparser import ConfigParser
from typing import Any

import pytest
import yaml

from dora_systemd.decisions.views import prometheus
from tests.unit.checkout import CHECKOUT
from tests.unit.project.test_manpages import sections

FOLDER = CHECKOUT / "packaging/monitoring"
PAGES = {name: (CHECKOUT / "docs" / f"{name}.md").read_text() for name in ("monitoring", "logs")}
RULES = FOLDER / "dora.rules.yml"
BOARD = json.loads((FOLDER / "grafana-dashboard.json").read_text())
_LABELS = {"instance", "dataflow", "node", "state", "resource", "kind", "output", "job", "machine"}


def metrics() -> set[str]:
    """The names of all metrics of /metrics; `up` is Prometheus' own."""
    families = (
        ("dora_dataflow_", prometheus._dataflow_samples(())),
        ("dora_node_", prometheus._node_samples(())),
    )
    found = {f"{prefix}{family.name}" for prefix, some in families for family, _ in some}
    return {*found, prometheus.BUILD.name, "up"}


def rules() -> list[dict[str, Any]]:
    return [one for group in yaml.safe_load(RULES.read_text())["groups"] for one in group["rules"]]


def check_expression(text: str) -> None:
    """Every metric and label of an expression exists."""
    bare = re.sub(r'"[^"]*"', "", text)
    used = set(re.findall(r"\b(?:dora_\w+|up)\b", bare))
    assert used and used <= metrics(), text
    labels = {one for inner in re.findall(r"{([^}]*)}", bare) for one in re.findall(r"\w+", inner)}
    assert labels <= _LABELS, text


def test_alerts_are_about_metrics_that_exist() -> None:
    for rule in rules():
        check_expression(rule["expr"])
        texts = " ".join(rule["annotations"].values())
        assert set(re.findall(r"\$labels\.(\w+)", texts)) <= _LABELS
        assert rule["alert"] in PAGES["monitoring"], "the page lists it"
    named = set(re.findall(r"`(Dora\w+)`", PAGES["monitoring"]))
    assert named == {one["alert"] for one in rules()}


@pytest.mark.skipif(not shutil.which("promtool"), reason="it is in Debian's package prometheus")
@pytest.mark.parametrize("what", ["check", "test"])
def test_promtool_accepts_the_alerts(what: str) -> None:
    """By hand: the lab does not have it."""
    file = RULES if what == "check" else RULES.with_name("dora.rules.test.yml")
    command = ["promtool", what, "rules", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def expressions() -> Iterator[str]:
    for panel in BOARD["panels"]:
        yield from (target["expr"] for target in panel["targets"])
    for variable in BOARD["templating"]["list"]:
        if variable["type"] == "query":
            assert variable["definition"] == variable["query"]["query"]
            yield re.sub(r"label_values\((.*), (\w+)\)", r"\1", variable["definition"])


def test_the_dashboard_shows_metrics_that_exist() -> None:
    for expression in expressions():
        check_expression(expression)
    variables = {one["name"] for one in BOARD["templating"]["list"]}
    text = json.dumps(BOARD["panels"])
    assert set(re.findall(r"\$\{?([a-z]+)\b", text)) <= variables
    shown = {one for text in expressions() for one in re.findall(r"dora_\w+", text)}
    alerted = {one for rule in rules() for one in re.findall(r"dora_\w+", rule["expr"])}
    assert alerted <= shown, "what an alert is about is on the dashboard"


def test_panels_have_a_place_each() -> None:
    taken: dict[tuple[int, int], int] = {}
    for panel in BOARD["panels"]:
        place = panel["gridPos"]
        for x in range(place["x"], place["x"] + place["w"]):
            for y in range(place["y"], place["y"] + place["h"]):
                assert x < 24 and (x, y) not in taken, panel["title"]
                taken[x, y] = panel["id"]
    ids = [panel["id"] for panel in BOARD["panels"]]
    assert len(set(ids)) == len(ids) == 15
    assert all(
        one["title"] and one["datasource"]["uid"] == "${datasource}" for one in BOARD["panels"]
    )


def fields() -> set[str]:
    """The fields that the manual has for lines and events."""
    return set(re.findall(r"DORA_[A-Z_]+", " ".join(sections("dora-systemd-logs.7").values())))


def test_vector() -> None:
    """Only read: Vector is not in Debian."""
    document = yaml.safe_load((FOLDER / "vector.yaml").read_text())
    (source,), (sink,) = document["sources"].values(), document["sinks"].values()
    assert source["include_matches"] == {"_SYSTEMD_SLICE": ["dora.slice"]}
    assert sink["inputs"] == list(document["sources"])
    check_fields((FOLDER / "vector.yaml").read_text())


TOKEN = re.compile(r'\s+|//[^\n]*|"[^"\n]*"|[\w.]+|[{}\[\]=,]')


def test_alloy() -> None:
    """Only its tokens and blocks: Alloy is not in Debian."""
    text = (FOLDER / "dora.alloy").read_text()
    assert "".join(TOKEN.findall(text)) == text
    open_: list[str] = []
    bare = re.sub(r'//[^\n]*|"[^"\n]*"', "", text)
    for one in re.findall(r"[{}\[\]]", bare):
        if one in "{[":
            open_.append(one)
        else:
            assert open_.pop() + one in ("{}", "[]")
    assert not open_
    named = set(re.findall(r'^(\w+\.\w+(?:\.\w+)?) "(\w+)"', text, re.M))
    components = {f"{kind}.{label}" for kind, label in named}
    used = set(re.findall(r"= \[?(\w+(?:\.\w+)+)\.(?:rules|receiver)", text))
    assert used and used <= components
    journal = [one.upper() for one in re.findall(r'"__journal_(\w+)"', text)]
    check_fields(" ".join(journal))
    assert "_HOSTNAME" in journal and "_SYSTEMD_SLICE=dora.slice" in text


def check_fields(text: str) -> None:
    used = set(re.findall(r"DORA_[A-Z_]+", text))
    assert used and used <= fields()


def test_journal_upload() -> None:
    found = ConfigParser()
    found.read(FOLDER / "journal-upload.conf")
    assert found.sections() == ["Upload"]
    assert found["Upload"]["URL"].startswith("http://")


@pytest.mark.parametrize("path", sorted(FOLDER.iterdir()), ids=lambda path: path.name)
def test_every_file_is_on_a_page_and_in_the_package(path: Any) -> None:
    assert any(f"`{path.name}`" in text for text in PAGES.values())
    installed = (CHECKOUT / "packaging/debian/dora-systemd.install").read_text()
    assert "packaging/monitoring/* /usr/share/dora-systemd/monitoring" in installed

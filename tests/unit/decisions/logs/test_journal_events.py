"""The table of life events, and the catalog that explains it."""

import re

import pytest

from dora_systemd.decisions.logs.journal_events import END_EVENTS, EVENTS, event_fields
from tests.unit.checkout import CHECKOUT

CATALOG = CHECKOUT / "units/templates/dora-systemd.catalog"


def catalog() -> dict[str, str]:
    """MESSAGE_ID -> entry."""
    entries = re.split(r"^-- ", CATALOG.read_text("utf-8"), flags=re.M)[1:]
    return {entry[:32]: entry[32:] for entry in entries}


def test_catalog_and_table_hold_the_same() -> None:
    assert set(catalog()) == {kind.message_id for kind in EVENTS.values()}


@pytest.mark.parametrize("name", EVENTS)
def test_catalog_entry_says_what_and_what_to_do(name: str) -> None:
    entry = catalog()[EVENTS[name].message_id]
    assert re.search(r"^Subject: .{10,70}$", entry, re.M)
    assert "Defined-By: dora-systemd" in entry
    assert len(entry.split("\n\n")) >= 3, "a paragraph on what it means, one on what to do"
    for field in re.findall(r"@(\w+)@", entry):
        assert field in {
            "DORA_DATAFLOW_NAME",
            "DORA_NODE",
            "DORA_BY",
            "DORA_EXIT",
            "DORA_FILE",
            "DORA_COUNT",
            "DORA_LIMIT",
            "DORA_MACHINE",
            "DORA_MOST",
            "DORA_OUTPUT",
            "DORA_THEN",
            "DORA_RELEASE",
            "DORA_FORMER",
            "DORA_REASON",
            "UNIT",
        }


def test_message_ids_are_unique_uuids() -> None:
    ids = [kind.message_id for kind in EVENTS.values()]
    assert len(set(ids)) == len(ids)
    assert all(re.fullmatch(r"[0-9a-f]{12}4[0-9a-f]{3}[89ab][0-9a-f]{15}", name) for name in ids)
    assert set(END_EVENTS) <= set(EVENTS)


def test_node_crashed() -> None:
    assert event_fields("node-crashed", dataflow="robot", node="cam", exit="exit code 1") == {
        "MESSAGE": "Node cam crashed: exit code 1",
        "MESSAGE_ID": "c2afc7aa5aac4b8882b951d397ce9297",
        "PRIORITY": 3,
        "DORA_EVENT": "node-crashed",
        "DORA_EXIT": "exit code 1",
    }


@pytest.mark.parametrize("name", EVENTS)
def test_a_detail_may_be_missing(name: str) -> None:
    assert event_fields(name)["DORA_EVENT"] == name


def test_the_text_names_a_node_that_was_removed() -> None:
    details = {"how": "removed", "reason": "flow.yml", "removed": "plot"}
    fields = event_fields("node-reloaded", dataflow="robot", node="", **details)
    assert fields["MESSAGE"] == "Node plot was removed: flow.yml"
    assert fields["DORA_NODE"] == "plot"


def test_details_cannot_replace_the_event() -> None:
    fields = event_fields("reloaded", dataflow="r", event="other", reason="2 files changed")
    assert fields["DORA_EVENT"] == "reloaded"
    assert fields["MESSAGE"] == "Dataflow r was reloaded: 2 files changed"
    assert fields["DORA_REASON"] == "2 files changed"


def test_what_is_not_known_is_told_so() -> None:
    assert event_fields("node-ready")["MESSAGE"] == "Node (node unknown) is ready"
    fields = event_fields("node-asked", node="a", asked="stop", by="eve", exit="", reason="x")
    assert fields["MESSAGE"] == "Node a: stop requested by eve: x"
    assert (fields["DORA_BY"], fields["DORA_EXIT"], fields["DORA_REASON"]) == ("eve", "", "x")
    both = event_fields("node-crashed", node="a", reason="late", exit="exit code 1")
    assert both["MESSAGE"] == "Node a crashed: exit code 1: late"
    assert not {"DORA_NODE", "DORA_DATAFLOW"} & {*event_fields("reloaded", dataflow="r", node="n")}

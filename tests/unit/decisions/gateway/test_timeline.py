"""The timeline of a dataflow, from records of its lives and of those of another one of its name."""

import pytest

from dora_systemd.decisions.gateway.timeline import (
    EVENTS,
    MARKS,
    MOST_LIVES,
    MOST_MARKS,
    timeline_values,
)
from dora_systemd.decisions.logs.journal_events import EVENTS as KNOWN
from dora_systemd.decisions.why.lives import UNIT_MESSAGES, Happening

OWN, OTHER = "own", "other"


def one(name: str, at_us: int, life: str = "1", uuid: str = OWN, **more: str) -> Happening:
    node = more.pop("node", "")
    details = {**({"dataflow": uuid} if uuid else {}), **more}
    return Happening(name, at_us, node, more.get("text", ""), life, "boot", details)


TWO_LIVES = (
    one("dataflow-starting", 10),
    one("dataflow-started", 12),
    one("node-crashed", 20, node="a", exit="exit code 3"),
    one("dataflow-failed", 21, nodes="a", reason="node a: exit code 3", cpu_peak="150"),
    one("unit-restart", 22, uuid=""),
    one("unit-starting", 23, "2", uuid=""),
    one("dataflow-starting", 24, "2"),
)


def test_lives_and_marks() -> None:
    found = timeline_values(TWO_LIVES, OWN, True, "boot")
    first, second = found["lives"]
    assert (first["began_us"], first["ready_us"], first["ended_us"]) == (10, 12, 21)
    assert (first["status"], first["text"]) == ("Failed", "node a: exit code 3")
    assert (first["cpu_peak_percent"], first["memory_peak_bytes"]) == (150, None)
    assert (second["began_us"], second["ended_us"], second["status"]) == (23, None, "")
    marks = [(mark["at_us"], mark["kind"], mark["node"]) for mark in found["marks"]]
    assert marks == [(20, "failure", "a"), (21, "failure", ""), (22, "restart", "")]
    assert found["marks"][0]["text"] == "node-crashed", "a record without a text has its name"
    assert found["is_cut"] is False


def test_the_last_life_has_ended_if_the_dataflow_is_down() -> None:
    *_, last = timeline_values(TWO_LIVES, OWN, False, "another boot")["lives"]
    assert (last["ended_us"], last["status"]) == (24, "Failed")
    assert "machine went down" in last["text"]


def test_requests_outside_belong_to_no_life() -> None:
    asked = one("start-asked", 5, "of doractl")
    written = one("bundle-written", 50, "of doractl")
    refused = one("bundle-refused", 51, "of doranotice")
    stop = one("stop-asked", 40, "of doractl", by="root (doractl stop)")
    end = one("dataflow-stopped", 41, "2")
    found = timeline_values((asked, *TWO_LIVES, stop, end, written, refused), OWN, False, "boot")
    assert len(found["lives"]) == 2
    assert found["lives"][1]["text"] == "stopped by root (doractl stop)"
    kinds = [mark["kind"] for mark in found["marks"]]
    assert (kinds[0], kinds[-3:]) == ("request", ["request", "bundle", "bundle"])


def test_lives_of_another_dataflow_of_that_name_are_left_out() -> None:
    before = (
        one("unit-starting", 1, "0", uuid=""),
        one("dataflow-failed", 2, "0", OTHER),
        one("unit-failed", 3, "0", uuid=""),
    )
    found = timeline_values((*before, *TWO_LIVES), OWN, True, "boot")
    assert [life["began_us"] for life in found["lives"]] == [10, 23]
    assert [mark["at_us"] for mark in found["marks"]] == [20, 21, 22]
    assert timeline_values(before, OWN, False, "boot")["lives"] == []


def test_what_nodes_have_forged_is_bounded() -> None:
    flood = [one("node-oom", at, node="x" * 9, text="y" * 9999) for at in range(30, 5000)]
    lives = [one("dataflow-starting", at, str(at)) for at in range(6000, 6500)]
    found = timeline_values([*TWO_LIVES, *flood, *lives], OWN, True, "boot")
    assert (len(found["marks"]), len(found["lives"])) == (MOST_MARKS, MOST_LIVES)
    assert found["is_cut"] is True
    assert max(len(mark["text"]) for mark in found["marks"]) == 300
    assert found["lives"][-1]["began_us"] == 6499, "the newest ones are kept"


@pytest.mark.parametrize("text", ["", "much", "-1", "9" * 30])
def test_a_peak_that_is_no_number_is_unknown(text: str) -> None:
    ended = (one("dataflow-starting", 1), one("dataflow-stopped", 2, held_peak=text))
    (life,) = timeline_values(ended, OWN, False, "boot")["lives"]
    assert life["memory_peak_bytes"] is None


def test_the_table_names_only_what_there_is() -> None:
    systemd = {*UNIT_MESSAGES.values(), "start-limit"}
    assert MARKS.keys() <= KNOWN.keys() | systemd
    assert set(EVENTS) <= KNOWN.keys()

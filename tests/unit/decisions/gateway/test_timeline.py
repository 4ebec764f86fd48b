"""The timeline of a dataflow, from records of its lives and of those of another one of its name."""

import pytest

from dora_systemd.decisions.gateway.timeline import (
    EVENTS,
    MARKS,
    MOST_LIVES,
    MOST_MARKS,
    Now,
    Use,
    parse_use,
    timeline_values,
)
from dora_systemd.decisions.logs.journal_events import EVENTS as KNOWN
from dora_systemd.decisions.logs.query import UNIT_RESOURCES
from dora_systemd.decisions.why.lives import UNIT_MESSAGES, Happening

OWN, OTHER = "own", "other"
UP, DOWN = Now("boot", 124, Use(50, 7 << 20)), Now("boot")


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
    found = timeline_values(TWO_LIVES, OWN, UP, {})
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
    *_, last = timeline_values(TWO_LIVES, OWN, Now("another boot"), {})["lives"]
    assert (last["ended_us"], last["status"]) == (24, "Failed")
    assert "machine went down" in last["text"]


def test_requests_outside_belong_to_no_life() -> None:
    asked = one("start-asked", 5, "of doractl")
    written = one("bundle-written", 50, "of doractl")
    refused = one("bundle-refused", 51, "of doranotice")
    stop = one("stop-asked", 40, "of doractl", by="root (doractl stop)")
    end = one("dataflow-stopped", 41, "2")
    found = timeline_values((asked, *TWO_LIVES, stop, end, written, refused), OWN, DOWN, {})
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
    found = timeline_values((*before, *TWO_LIVES), OWN, UP, {})
    assert [life["began_us"] for life in found["lives"]] == [10, 23]
    assert [mark["at_us"] for mark in found["marks"]] == [20, 21, 22]
    assert timeline_values(before, OWN, DOWN, {})["lives"] == []


def test_what_nodes_have_forged_is_bounded() -> None:
    flood = [one("node-oom", at, node="x" * 9, text="y" * 9999) for at in range(30, 5000)]
    lives = [one("dataflow-starting", at, str(at)) for at in range(6000, 6500)]
    found = timeline_values([*TWO_LIVES, *flood, *lives], OWN, UP, {})
    assert (len(found["marks"]), len(found["lives"])) == (MOST_MARKS, MOST_LIVES)
    assert found["is_cut"] is True
    assert max(len(mark["text"]) for mark in found["marks"]) == 300
    assert found["lives"][-1]["began_us"] == 6499, "the newest ones are kept"


@pytest.mark.parametrize("text", ["", "much", "-1", "9" * 30])
def test_a_peak_that_is_no_number_is_unknown(text: str) -> None:
    ended = (one("dataflow-starting", 1), one("dataflow-stopped", 2, held_peak=text))
    (life,) = timeline_values(ended, OWN, DOWN, {})["lives"]
    assert life["memory_peak_bytes"] is None


def test_what_lives_have_used_before_the_page_was_opened() -> None:
    recorded = {"1": Use(11, 5 << 20)}
    first, second = timeline_values(TWO_LIVES, OWN, UP, recorded)["lives"]
    assert (first["cpu_average_percent"], first["cpu_peak_percent"]) == (100.0, 150)
    assert first["memory_peak_bytes"] == 5 << 20, "systemd's record, without one of ours"
    assert (second["cpu_average_percent"], second["memory_peak_bytes"]) == (49.5, 7 << 20)
    ended = (one("dataflow-starting", 1), one("dataflow-stopped", 2, held_peak="3"))
    (life,) = timeline_values(ended, OWN, DOWN, recorded)["lives"]
    assert life["memory_peak_bytes"] == 3, "ours is without files that the kernel can drop"
    (life,) = timeline_values(ended[:1], OWN, DOWN, recorded)["lives"]
    assert life["cpu_average_percent"] is None, "a life without a duration has no average"


RESOURCES = {"MESSAGE_ID": UNIT_RESOURCES, "INVOCATION_ID": "1", "CPU_USAGE_NSEC": "11000"}


def test_systemd_s_record_of_what_a_unit_has_used() -> None:
    assert parse_use(RESOURCES) == ("1", Use(11, None))
    in_user_scope = {**RESOURCES, "INVOCATION_ID": None, "USER_INVOCATION_ID": "2"}
    assert parse_use({**in_user_scope, "MEMORY_PEAK": "5"}) == ("2", Use(11, 5))
    assert parse_use({**RESOURCES, "CPU_USAGE_NSEC": "9" * 30}) == ("1", Use())
    assert parse_use({**RESOURCES, "MESSAGE_ID": "x"}) is None
    assert parse_use({**RESOURCES, "DORA_EVENT": "node-ready"}) is None, "a node has forged it"


def test_the_table_names_only_what_there_is() -> None:
    systemd = {*UNIT_MESSAGES.values(), "start-limit"}
    assert MARKS.keys() <= KNOWN.keys() | systemd
    assert set(EVENTS) <= KNOWN.keys()

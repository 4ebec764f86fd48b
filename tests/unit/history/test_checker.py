"""Each invariant with a history that breaks it, and one that breaks none."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from tests.history.checker import INVARIANTS, check
from tests.history.history import Answer, CellView, History, Line, Look, Sight, Vital
from tests.history.steps import CELLS, LOOK, NO_TARGET, Step
from tests.history.views import wish_at
from tests.lab.pace import SLOWEST

A, B = CELLS
UNIT = f"dora-{A}.service"
GROUP = f"/dora.slice/{UNIT}/node-sink"
ROW: dict[str, Any] = {
    **{"name": A, "uuid": "1", "status": "Running", "restarts": 0, "summary": "it runs"},
    "nodes": [{"node": "sink", "state": "running", "pid": 9, "restarts": 0}],
    "restart_history": [],
}


def unit(**changes: str) -> dict[str, str]:
    """Properties of a unit that runs."""
    return {"ActiveState": "active", "LoadState": "loaded", "NRestarts": "0", **changes}


def view(listed: Mapping[str, Any] | None = ROW, why: Any = ROW, **changes: str) -> CellView:
    """What everyone says of a cell that runs; metrics agree with `list`."""
    metrics: dict[str, float] = {}
    if listed:
        state = f'dora_dataflow_state{{state="{listed["status"].lower()}"}}'
        metrics = {"dora_dataflow_restarts_total{}": listed["restarts"], state: 1}
    return CellView(unit(**changes), listed, why, metrics, {"node-sink": (9,)})


GONE = view(None, None, ActiveState="inactive", LoadState="not-found")


def look(at: int, of_a: CellView | None = None, vital: Vital | None = None) -> Look:
    """A quiet look at a dataflow that runs and one that is not there."""
    vitals = {"PID 1": vital or Vital(1, 1, 9000, 90)}
    return Look(at, True, 1.0, {A: of_a or view(), B: GONE}, vitals, float(at))


def answer(at: int, what: str, status: int = 0, **more: Any) -> Answer:
    """A step that took most of its second."""
    times = {"begun": float(at), "ended": at + 0.9}
    return Answer(at, Step(what), status, **{"stderr": "doractl: no", **times, **more})


def sight(
    invocation: str = "i", group: str = GROUP, seen_s: float = 0.5, began: int = 100
) -> Sight:
    """A process of A."""
    return Sight(A, 9, began, invocation, group, seen_s)


GOOD = History(
    steps=(Step("start"), Step(LOOK), Step("list"), Step(LOOK)),
    answers=(answer(0, "start"), answer(2, "list")),
    sights=((sight(),),),
    looks=(look(1), look(3)),
    printed={(A, "sink.1"): 2},
    lines=(Line(A, "sink.1", 1), Line(A, "sink.1", 2), Line(A, "sink.1", 3)),
    end=tuple(answer(-1, what) for what in ("disable", "destroy", "reset")),
)
BY_DORA = {"owner": "dora", "node": "sink"}
FAILED = {**ROW, "status": "Failed", "nodes": []}
SILENT = {**FAILED, "summary": ""}
GROWN = tuple(look(at, vital=Vital(1, 1, 9000 * at, 90)) for at in range(1, 9))
OPENED = tuple(look(at, vital=Vital(1, 1, 9000, 90 * at)) for at in range(1, 9))


def last(of_a: CellView) -> dict[str, Any]:
    """A change of GOOD: what everyone says at the last look."""
    return {"looks": (look(1), look(3, of_a))}


ROLLBACK = "root (doractl rollback)"


def ran(former: str, release: str, ended: str, by: str = "root (doractl deploy)") -> dict[str, str]:
    """A change of what runs."""
    return {"from": former, "to": release, "ended": ended, "by": by}


BACK = (ran("x", "y", "replaced"), ran("y", "x", "rolled-back", ROLLBACK))
LATER = ran("w", "y", "rolled-back", ROLLBACK)
NAMELESS = tuple(replace(line, has_unit=False) for line in GOOD.lines)


def stopped(status: str = "Running", **changes: Any) -> dict[str, Any]:
    """The row of a dataflow whose node somebody has stopped."""
    node = {"state": "stopped", "pid": None, "stopped_by": "root", **changes}
    return {**ROW, "status": status, "nodes": [{**ROW["nodes"][0], **node}]}


BROKEN: list[tuple[str, dict[str, Any]]] = [
    ("one_life_at_a_time", {"sights": ((sight("i"), sight("j", began=200)), (sight("i"),))}),
    ("one_life_at_a_time", {"sights": ((sight("j", began=200), sight("")),)}),
    ("inside_the_unit", {"sights": ((sight(group="/user.slice"),),)}),
    ("restarts_are_counted_once", {"sights": ((sight("i"), sight("j", seen_s=2.0)),)}),
    ("last_wish_or_reason", {"answers": (answer(0, "start"), answer(2, "stop"))}),
    ("last_wish_or_reason", last(view(SILENT, SILENT, ActiveState="failed"))),
    ("last_wish_or_reason", last(GONE)),
    ("views_agree", last(view(None))),
    ("views_agree", last(view(why=None))),
    ("views_agree", last(view(FAILED, FAILED))),
    ("views_agree", last(view(why=FAILED))),
    ("views_agree", last(view(why={**ROW, "uuid": "2"}))),
    ("views_agree", last(view(NRestarts="1"))),
    ("views_agree", last(view(None, ROW, ActiveState="inactive"))),
    ("views_agree", last(replace(view(), metrics={"dora_dataflow_restarts_total{}": 7}))),
    ("why_lists_each_restart", last(view(why={**ROW, "restart_history": [BY_DORA]}))),
    ("nodes_are_real", last(replace(view(), pids={"node-sink": (10,)}))),
    ("what_a_hand_stops_is_no_failure", last(view(stopped(pid=9), stopped()))),
    ("what_a_hand_stops_is_no_failure", last(view(stopped("Degraded"), stopped("Degraded")))),
    ("what_a_hand_stops_is_no_failure", last(view(stopped(), {**stopped(), "node": "sink"}))),
    ("nodes_obey", {"answers": (answer(0, "start"), answer(2, "node-stop"))}),
    ("uuid_is_stable", last(view({**ROW, "uuid": "2"}, {**ROW, "uuid": "2"}))),
    ("every_line_once", {"printed": {(A, "sink.1"): 4}}),
    ("every_line_once", {"lines": (*GOOD.lines, Line(A, "sink.1", 2))}),
    ("every_line_once", {"lines": GOOD.lines[::-1]}),
    ("every_line_once", {"lines": NAMELESS}),
    ("every_line_once", {"lines": NAMELESS, "answers": (answer(2, "kill-runner"),)}),
    ("quiet_comes", {"looks": (replace(look(1), is_quiet=False),)}),
    ("answers_are_orderly", {"answers": (answer(0, "start", -9),)}),
    ("answers_are_orderly", {"answers": (answer(0, "set", 2),)}),
    ("answers_are_orderly", {"answers": (answer(0, "set", 3, stderr="doractl: [Errno 2]"),)}),
    (
        "answers_are_orderly",
        {"end": (answer(-1, "x", stderr="Traceback (most recent call last)"),)},
    ),
    ("an_error_says_something", {"answers": (answer(0, "start", 1, stderr=""),)}),
    ("nothing_is_left", {"left": ("unit dora-x.service",)}),
    ("nothing_is_left", {"end": (answer(-1, "disable", 4), answer(-1, "destroy", 1))}),
    ("everything_is_flat", {"looks": GROWN}),
    ("everything_is_flat", {"looks": OPENED}),
    ("rollbacks_choose_what_ran_well", {"ran": {A: (*BACK, ran("x", "y", "replaced", ROLLBACK))}}),
    ("rollbacks_choose_what_ran_well", {"ran": {A: (ran("y", "x", "failed"), LATER)}}),
]


def test_a_rollback_to_what_ran_well() -> None:
    again = (*BACK, ran("x", "z", "replaced"), ran("z", "x", "rolled-back", ROLLBACK))
    interrupted = ran("x", "z", "interrupted", ROLLBACK)
    named = (*BACK, ran("x", "y", "replaced"), ran("y", "w", "replaced"), LATER)
    for found in (BACK, again, (*BACK, interrupted), named):
        assert check(replace(GOOD, ran={A: found})) == []


def test_a_good_history_breaks_nothing() -> None:
    assert check(GOOD) == []


def test_a_node_that_obeys_breaks_nothing() -> None:
    answers = (answer(0, "start"), answer(2, "node-stop"))
    assert check(replace(GOOD, answers=answers, **last(view(stopped(), stopped())))) == []


def test_a_restart_before_a_start_counts() -> None:
    """The start sets systemd's counter to 0 again."""
    sights = ((sight("i"), sight("j", seen_s=2.0), sight("k", seen_s=2.5)),)
    twice = replace(GOOD, sights=sights, answers=(answer(0, "start"), answer(2, "start")))
    assert check(twice) != []
    assert check(replace(twice, restarts={A: (1.5,)})) == []
    assert check(replace(twice, restarts={A: (0.5,), B: (1.5,)})) != []


@pytest.mark.parametrize(("name", "changes"), BROKEN)
def test_an_invariant_is_broken(name: str, changes: dict[str, Any]) -> None:
    complaints = check(replace(GOOD, **changes))
    assert name in {one.invariant for one in complaints}, complaints


def test_every_invariant_is_broken_here() -> None:
    assert {name for name, _ in BROKEN} == set(INVARIANTS)


def test_a_machine_that_is_too_slow_is_named_and_not_forgiven() -> None:
    slow = replace(look(1), is_quiet=False, pace=SLOWEST)
    (complaint,) = check(replace(GOOD, looks=(slow,), answers=()))
    assert "too slow to judge" in complaint.text


def test_counted_lines_may_be_missing() -> None:
    assert check(replace(GOOD, printed={(A, "sink.1"): 5}, lost={A: 2})) == []


def test_lines_may_be_missing_where_no_runner_could_follow_the_killed_one() -> None:
    lost = replace(GOOD, printed={(A, "sink.1"): 5})
    killed = (*GOOD.answers, replace(answer(2, "kill-runner"), step=Step("kill-runner", A)))
    away = replace(answer(2, "project-deleted"), step=Step("project-deleted", A))
    assert check(replace(lost, answers=killed)) != []
    assert check(replace(lost, answers=(*killed, away))) == []


def test_lines_may_repeat_where_the_runner_is_killed() -> None:
    twice = (*GOOD.lines, Line(A, "sink.1", 2))
    killed = (*GOOD.answers, answer(2, "kill-runner"))
    assert check(replace(GOOD, lines=twice, answers=killed)) == []


@pytest.mark.parametrize(
    ("restarts", "faults", "is_broken"),
    [
        (1, ("journald-restarts",), False),
        (2, ("journald-restarts",), True),
        (2, ("journald-restarts", "journald-restarts"), False),
        (1, ("daemon-reexec",), True),
    ],
)
def test_pid_1_records_nothing_while_journald_restarts(
    restarts: int, faults: tuple[str, ...], is_broken: bool
) -> None:
    row = {**ROW, "restarts": restarts}
    counted = replace(GOOD, **last(view(row, row, NRestarts=str(restarts))))
    hits = [answer(2, fault) for fault in faults]
    complaints = check(replace(counted, answers=(*GOOD.answers, *hits)))
    broken = {one.invariant for one in complaints}
    assert ("why_lists_each_restart" in broken) is is_broken, complaints


def test_a_new_journald_knows_no_unit_of_a_process_that_was_killed() -> None:
    faults = (answer(2, "kill-runner"), answer(2, "journald-restarts"))
    assert check(replace(GOOD, lines=NAMELESS, answers=(*GOOD.answers, *faults))) == []


def test_a_doractl_that_was_killed_may_end_by_a_signal() -> None:
    killed = (answer(0, "start", -9, was_hit=True), answer(0, "kill-gateway", NO_TARGET, stderr=""))
    assert check(replace(GOOD, answers=killed)) == []


def test_a_failure_with_a_reason_is_as_good_as_a_dataflow_that_runs() -> None:
    failed = view(FAILED, FAILED, ActiveState="failed")
    assert check(replace(GOOD, **last(failed))) == []


@pytest.mark.parametrize(
    ("answers", "wish"),
    [
        ([], ""),
        ([answer(0, "start")], "run"),
        ([answer(0, "start"), answer(1, "destroy")], "stop"),
        ([answer(0, "stop"), answer(1, "start", 6)], "stop"),
        ([answer(0, "stop"), answer(1, "start", 1)], None),
        ([answer(0, "stop"), answer(0, "start")], None),
        ([answer(0, "stop", was_hit=True, status=-9)], None),
    ],
)
def test_what_was_asked_for_last(answers: list[Answer], wish: str | None) -> None:
    history = replace(GOOD, answers=tuple(answers))
    assert wish_at(history, 9, A) == wish

"""Invariants of what the views say of the same dataflow at the same time. Pure."""

from collections import Counter
from collections.abc import Iterator

from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.views.dataflows import UP_WORDS
from tests.history.history import Answer, CellView, History, Look
from tests.history.steps import CELLS, COMMANDS, Step, Wish

UNCHANGED = frozenset({4, 6, 10, 11})
"""Exit statuses of a command that changes nothing: not found, name in use, inhibited, and rolled
back to what ran before."""
_MAKE_A_UUID = ("start", "deploy", "rollback", "run")
RUNNING = frozenset({"Running", "Degraded"})
ENDED = frozenset({"Stopped", "Finished"})
BY_STATE = {
    "active": RUNNING,
    "failed": frozenset({"Failed"}),
    # A stop that calls a restart off leaves systemd inactive, and the last life failed.
    "inactive": ENDED | {"Failed"},
}


def quiet_looks(history: History) -> Iterator[tuple[Look, str, CellView]]:
    """Each cell at each look at which nothing changed."""
    for look in history.looks:
        if look.is_quiet:
            yield from ((look, cell, look.cells[cell]) for cell in CELLS)


def last_wish_or_reason(history: History) -> Iterator[str]:
    """What was asked for last is so, or `why` gives a reason."""
    for look, cell, view in quiet_looks(history):
        wish, state = wish_at(history, look.at, cell), view.unit["ActiveState"]
        if wish is Wish.STOP and state not in ("inactive", "failed"):
            yield f"step {look.at}: {cell} was to stop, and is {state}"
        if wish is Wish.RUN and state != "active" and not _is_explained(view):
            yield f"step {look.at}: {cell} was to run, is {state}, and why says {view.why}"


def _is_explained(view: CellView) -> bool:
    why = view.why
    return why is not None and bool(why["summary"]) and why["status"] not in UP_WORDS


def wish_at(history: History, at: int, cell: str) -> Wish | None:
    """What was asked for last before step `at`; None where two asked at once for different
    things, or a command failed in the middle."""
    wish: Wish | None = Wish.NOTHING
    asked = [one for one in history.answers if one.at < at and _concerns(one.step, cell)]
    for one in sorted(asked, key=lambda answer: answer.ended):
        rivals = {_wish(other) for other in asked if _overlap(one, other)}
        if one.status in UNCHANGED and not one.was_hit:
            continue
        wish = _wish(one) if one.status == 0 and len(rivals) == 1 else None
    return wish


def _wish(answer: Answer) -> Wish:
    return COMMANDS[answer.step.what].wish


def _concerns(step: Step, cell: str) -> bool:
    command = COMMANDS.get(step.what)
    return bool(command and command.wish) and (step.cell == cell or _is_for_all(step))


def _is_for_all(step: Step) -> bool:
    return COMMANDS[step.what].is_for_all


def _overlap(one: Answer, other: Answer) -> bool:
    return one.begun < other.ended and other.begun < one.ended


def views_agree(history: History) -> Iterator[str]:
    """systemd, `list`, `why` and /metrics say the same."""
    for look, cell, view in quiet_looks(history):
        for text in (*_of_list(view), *_of_why(view), *_of_metrics(view)):
            yield f"step {look.at}: {cell}: {text}"


def _of_list(view: CellView) -> Iterator[str]:
    state, listed = view.unit["ActiveState"], view.listed
    if listed is None:
        if state != "inactive":
            yield f"it is {state}, and list does not know it"
        return
    if listed["status"] not in BY_STATE.get(state, ()):
        yield f"it is {state}, and list says {listed['status']}"
    # systemd counts the restart that the runner has refused, too.
    is_refused = view.unit.get("ExecMainStatus") == str(RunnerExit.RESTARTS_SPENT.value)
    restarts = max(int(view.unit["NRestarts"]) - is_refused, 0)
    if listed["restarts"] not in (None, restarts):
        yield f"systemd has made {restarts} restarts, list has {listed['restarts']}"


def _of_why(view: CellView) -> Iterator[str]:
    listed, why = view.listed, view.why
    if why is None:
        if listed is not None:
            yield "list knows it, and why does not"
        return
    if listed is None:
        if why["status"] in UP_WORDS:
            yield f"list does not know it, and why says {why['status']}"
        return
    for key in ("uuid", "restarts"):
        # What is null is unknown: systemd forgets a dataflow, and `why` has it loaded again.
        if None not in (why[key], listed[key]) and why[key] != listed[key]:
            yield f"{key}: list says {listed[key]}, why {why[key]}"
    if why["status"] != listed["status"] and not {why["status"], listed["status"]} <= ENDED:
        yield f"list says {listed['status']}, why {why['status']}: {why['summary']}"


def _of_metrics(view: CellView) -> Iterator[str]:
    if view.listed is None or not view.metrics:
        return
    restarts = view.metrics.get("dora_dataflow_restarts_total{}")
    if view.listed["restarts"] not in (None, restarts):
        yield f"list counts {view.listed['restarts']} restarts, /metrics {restarts}"
    series = f'dora_dataflow_state{{state="{view.listed["status"].lower()}"}}'
    if view.metrics.get(series) != 1:
        yield f"list says {view.listed['status']}, /metrics does not"


def why_lists_each_restart(history: History) -> Iterator[str]:
    """`why` lists as many restarts of a dataflow that runs, and of its nodes, as are counted."""
    for look, cell, view in quiet_looks(history):
        if view.why is None or view.listed is None or view.unit["ActiveState"] != "active":
            continue
        told = Counter((one["owner"], one["node"]) for one in view.why["restart_history"])
        counts = {("dora", node["node"]): node["restarts"] for node in view.listed["nodes"]}
        counts["systemd", None] = view.listed["restarts"]
        for key, count in counts.items():
            lost = _times_of_mute_systemd(history, look.at) if key[0] == "systemd" else 0
            if not told[key] <= count <= told[key] + lost:
                yield f"step {look.at}: {cell}: {key}: {count} are counted, why lists {told[key]}"


def _times_of_mute_systemd(history: History, at: int) -> int:
    """While journald restarts, PID 1 records to the kernel's ring, which a container has not."""
    steps = [one.step.what for one in history.answers if one.at <= at]
    return steps.count("journald-restarts")


def what_a_hand_stops_is_no_failure(history: History) -> Iterator[str]:
    """A node that somebody has stopped says so, does nothing, and fails nothing."""
    for look, cell, view in quiet_looks(history):
        nodes = (view.listed or {}).get("nodes", ())
        stopped = {node["node"]: node for node in nodes if node.get("stopped_by")}
        for name, node in stopped.items():
            if node["state"] != "stopped" or node["pid"]:
                yield f"step {look.at}: {cell}: {name} was stopped, and is {node}"
        states = {node["state"] for node in nodes if node["node"] not in stopped}
        status = (view.listed or {}).get("status")
        if stopped and states <= {"running"} and status != "Running":
            yield f"step {look.at}: {cell}: only stopped nodes are down, and it is {status}"
        if view.why and stopped and view.why.get("node") in stopped:
            yield f"step {look.at}: {cell}: why blames {view.why['node']}, which was stopped"


_ORDERS = {
    "node-restart": ("source", ("running", "waiting")),
    "node-restart-sink": ("sink", ("running", "waiting")),
    "node-stop": ("sink", ("stopped",)),
    "node-stop-source": ("source", ("stopped",)),
}


def nodes_obey(history: History) -> Iterator[str]:
    """A node is as the last command for it says, if that has succeeded just before a look."""
    looks = {look.at: look for look in history.looks if look.is_quiet}
    for answer in history.answers:
        node, states = _ORDERS.get(answer.step.what, ("", ()))
        look = looks.get(answer.at + 1)
        if not node or look is None or answer.status or answer.step.is_joined or answer.was_hit:
            continue
        view = look.cells[answer.step.cell]
        rows = (view.listed or {}).get("nodes", ()) if view.unit["ActiveState"] == "active" else ()
        for row in rows:
            is_refused = "Node not running" in answer.stdout
            if row["node"] == node and row["state"] not in states and not is_refused:
                yield f"step {look.at}: {answer.step.what} succeeded, and it is {row['state']}"


def nodes_are_real(history: History) -> Iterator[str]:
    """A node that runs is exactly the process that is in its group."""
    for look, cell, view in quiet_looks(history):
        for node in (view.listed or {}).get("nodes", ()):
            pids = view.pids.get(f"node-{node['node']}", ())
            is_here = not node.get("machine")
            if is_here and node["state"] == "running" and node["pid"] not in pids:
                what = f"{node['node']} is {node['pid']}, its group has {pids}"
                yield f"step {look.at}: {cell}: {what}"


def uuid_is_stable(history: History) -> Iterator[str]:
    """A dataflow keeps its UUID while nobody asks for a start."""
    for before, after in zip(history.looks, history.looks[1:], strict=False):
        for cell in CELLS:
            rows = before.cells[cell].listed, after.cells[cell].listed
            old, new = (row["uuid"] if row else "" for row in rows)
            is_other = old and new and old != new
            if is_other and not _was_started(history, cell, before.at, after.at):
                yield f"{cell}: {old} became {new} by step {after.at}"


def _was_started(history: History, cell: str, first: int, last: int) -> bool:
    asked = (one.step for one in history.answers if first < one.at < last)
    return any(step.what.startswith(_MAKE_A_UUID) and step.cell == cell for step in asked)

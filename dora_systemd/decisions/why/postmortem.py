"""Finds what happened to a dataflow, and why: the verdict of `doractl why`. Pure.

If the cause is not recorded, the verdict states that: a verdict never guesses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dora_systemd.decisions.cell.exits import KILLED, ExitKind, exit_of, parse_exit
from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.cell.owes import STARVED
from dora_systemd.decisions.cell.status import RESTART
from dora_systemd.decisions.life.causes import (
    BY_SIGKILL,
    ESSENTIAL,
    NO_END,
    RUNNER_KILLED,
    UNIT_RESULTS,
    Cause,
    result_words,
)
from dora_systemd.decisions.life.refusal import setup_failure
from dora_systemd.decisions.logs.journal_events import NODE_END_EVENTS, NODE_FAILURES
from dora_systemd.decisions.reload.changes import How
from dora_systemd.decisions.views.dataflows import FAILED, FINISHED, RESTARTING, STOPPED, UP_WORDS
from dora_systemd.decisions.watchdog.judge import by_watchdog
from dora_systemd.decisions.why.lives import Happening, Life, ended_nodes, with_restarts
from dora_systemd.decisions.why.verdict import Facts, Restart, Verdict
from dora_systemd.names import is_node_id
from dora_systemd.values import SECOND

_LOSSES = (Cause.DAEMON_LOST, Cause.COORDINATOR_LOST, Cause.MACHINE_LOST)
"""Causes with the same names as their events."""
_END_WORDS = {"dataflow-finished": FINISHED, "dataflow-stopped": STOPPED, "dataflow-failed": FAILED}
_ENDS = (*_END_WORDS, "unit-succeeded", "unit-failed")
_OOM_SPAN = 10 * SECOND
"""Maximum µs between systemd's records of an OOM kill and of the end of the killed process."""
UNKNOWN_PERSON = "a request to systemd (by whom is not recorded)"


def _found(
    cause: Cause, summary: str, at: Happening | None = None, node: str = "", by: str = ""
) -> Verdict:
    """The part of a verdict that explains an end."""
    at_us, details = (at.at_us, at.details) if at else (0, {})
    return Verdict("", cause, summary, node=node, at_us=at_us, stopped_by=by, details=details)


_CALLED_OFF = {"unit-starting", "stop-asked", "unit-stopping", "unit-succeeded", "unit-stopped"}
"""What is recorded of a restart that was stopped before the runner had begun."""


def examine(lives: Sequence[Life], facts: Facts, shutdowns: Sequence[int] = ()) -> Verdict:
    """The verdict on the last of `lives`, which are oldest first.

    shutdowns: CLOCK_REALTIME µs of shutdown requests for the machine.
    """
    # What is recorded is of earlier lives, as long as systemd has not begun this one.
    chain = [] if facts.is_held else with_restarts(lives)
    life = chain[-1] if chain else Life()
    is_spent = _is_spent(life)
    if len(chain) > 1 and (is_spent or _says_nothing(life, facts)):
        life = chain[-2]
    status = facts.status if facts.status in UP_WORDS else ended_word(life, facts.status)
    if facts.is_gathering:
        found = _gathering(chain)
    elif status in UP_WORDS and status != RESTARTING:
        found = _present(life, facts)
    else:
        found = _end(life, facts, shutdowns)
    if found.cause in (Cause.STOPPED, Cause.FINISHED):
        status = STOPPED if found.cause is Cause.STOPPED else FINISHED
    earlier = lives[: len(lives) - len(chain)]
    before = _end(earlier[-1], facts, shutdowns) if earlier else _found(Cause.NONE, "")
    happenings = (one for each in chain for one in each.happenings)
    return replace(
        found,
        status=status,
        now=facts.text if status in UP_WORDS else "",
        began_us=life.began_us,
        ready_us=ready.at_us if (ready := life.last("dataflow-started")) else 0,
        invocation=life.invocation,
        is_given_up=is_spent or life.last("start-limit") is not None,
        starved=_starved(found, life),
        restarts=tuple(_counted(_done(restarts_of(chain), is_spent), life, facts)),
        timeline=tuple(one for one in happenings if one.name not in _NO_NEWS),
        before=before.summary,
        before_us=before.at_us,
        nodes=() if status in UP_WORDS else ended_nodes(life),
        stopped=facts.stopped,
        policy=facts.policy,
    )


def _is_spent(life: Life) -> bool:
    """Whether the runner has refused this restart: the life before has recorded the failure."""
    end = life.last("dataflow-failed")
    return end is not None and end.detail("cause") == Cause.RESTARTS_SPENT


def _done(restarts: list[Restart], is_spent: bool) -> list[Restart]:
    """The restarts without the last one by systemd, if the runner has refused that."""
    last = max((n for n, one in enumerate(restarts) if one.owner == "systemd"), default=None)
    return [one for n, one in enumerate(restarts) if not (is_spent and n == last)]


def _says_nothing(life: Life, facts: Facts) -> bool:
    """Whether the runner of a restart still waits for its delay, or was stopped before it began."""
    names = {one.name for one in life.happenings}
    if facts.status in {*UP_WORDS, STOPPED}:  # systemd has the unit, where anyone sees it
        return facts.status == RESTARTING and names <= {"unit-starting"}
    return names <= _CALLED_OFF and "unit-succeeded" in names


def ended_word(life: Life, known: str = "") -> str:
    """Return how a life ended. known: systemd's status, "" if it has unloaded the unit."""
    end = life.last(*_ENDS)
    if end is None:
        return FAILED if life.happenings else known or STOPPED
    if end.name == "unit-succeeded":
        own = life.last(*_END_WORDS)
        return _END_WORDS[own.name] if own else STOPPED
    return _END_WORDS.get(end.name, FAILED)


def _present(life: Life, facts: Facts) -> Verdict:
    """Describe a running dataflow: a node that failed and stays down, else the last restart."""
    gone = [one for one in final_crashes(life) if one.node in facts.failed]
    if gone:
        # The live table has the number of restarts.
        first, *others = _own(gone, facts.failed)
        summary = f"node {first.node}: {facts.failed[first.node]}"
        return _with_others(replace(_crash(first), summary=summary), others, facts.failed)
    waiting = [one for one in final_crashes(life) if one.node in facts.restarting]
    if waiting:
        return replace(_crash(waiting[-1]), is_passing=True)
    for node, missing in facts.silent.items():
        said = [one for one in life.all("node-silent") if one.node == node]
        at = said[-1] if said else None
        _, is_starved, source = missing.rpartition(STARVED)
        if is_starved:  # who sends nothing to it is to blame
            origin = source.partition("/")[0]
            words = f"node {origin}: sends nothing; {node}: {missing}"
            return _found(Cause.NODE_SILENT, words, at, origin if is_node_id(origin) else node)
        return _found(Cause.NODE_SILENT, f"node {node}: {missing}", at, node)
    return _found(Cause.NONE, "")


def _gathering(chain: Sequence[Life]) -> Verdict:
    """The loss of the machine that a dataflow waits for; nothing if it has never been there."""
    lost = [one for life in chain for one in life.all(Cause.MACHINE_LOST)]
    if not lost:
        return _found(Cause.NONE, "")
    machine, reason = (lost[-1].detail(key) for key in ("machine", "reason"))
    return _found(Cause.MACHINE_LOST, f"machine {machine}: {reason}", lost[-1])


def final_crashes(life: Life) -> list[Happening]:
    """The last crash of each node, earliest first: the others may be consequences of it."""
    last = {one.node: one for one in life.all(*NODE_FAILURES)}
    return sorted(last.values(), key=lambda one: one.at_us)


def _crash(crash: Happening) -> Verdict:
    exit = parse_exit(crash.detail("exit"))
    cause = Cause.NODE_FAILED
    if crash.name == "node-oom":
        cause = Cause.NODE_OUT_OF_MEMORY
    elif exit.kind is ExitKind.HUNG:
        cause = Cause.NODE_WATCHDOG if by_watchdog(exit.words) else Cause.NODE_HUNG
    elif exit.kind is ExitKind.SILENT:
        cause = Cause.NODE_SILENT
    how = str(exit) or "ended, how is not recorded"
    return _found(cause, f"node {crash.node}: {how}", crash, crash.node)


def _end(life: Life, facts: Facts, shutdowns: Sequence[int]) -> Verdict:
    if (failure := life.last("dataflow-failed")) is not None:
        if failure.detail("reason") == BY_SIGKILL and _is_kill_requested(life, failure):
            by = stopped_by(life, shutdowns)  # with --now
            return _found(Cause.STOPPED, f"stopped by {by}; killed", failure, by=by)
        return _failure(life, failure)
    if (end := life.last("unit-failed")) is not None:
        return _unit_failure(life, end)
    if (end := life.last("dataflow-finished")) is not None:
        return _found(Cause.FINISHED, "all nodes ended by themselves", end)
    if (end := life.last("dataflow-stopped", "unit-succeeded")) is not None:
        by = stopped_by(life, shutdowns)
        return _found(Cause.STOPPED, f"stopped by {by}{_killed_at_stop(life)}", end, by=by)
    return _without_end(life, facts)


def _failure(life: Life, end: Happening) -> Verdict:
    reason = end.detail("reason") or "for a reason that is not recorded"
    named = end.detail("nodes").split()
    crashes = [one for one in final_crashes(life) if not named or one.node in named]
    cause = _cause_of(life, end)
    ends = _ends(reason, named)
    if cause is Cause.NODE_FAILED and crashes:
        first, *others = _own(crashes, ends)
        found = _crash(first)
        if reason.startswith(ESSENTIAL):
            return replace(found, summary=reason)
        summary = _with_tail(found.summary, ends.get(first.node, ""))
        return _with_others(replace(found, summary=summary), others, ends)
    node = named[0] if named else ""
    lost = life.last(*_LOSSES)
    return _found(cause, reason, lost if cause in _LOSSES and lost else end, node)


def _ends(reason: str, named: Sequence[str]) -> dict[str, str]:
    """Parse how each node ended, from the reason of a failed dataflow."""
    parts = (one.partition(": ") for one in f", {reason}".split(", node "))
    return {node: how for node, _, how in parts if node in named}


def _own(crashes: Sequence[Happening], ends: Mapping[str, str]) -> Sequence[Happening]:
    """The crashes that no crash of another node has caused, or all if there are none."""
    victims = {node for node, how in ends.items() if parse_exit(how).by}
    own = [
        one for one in crashes if one.node not in victims and not parse_exit(one.detail("exit")).by
    ]
    return own or crashes


_MOST_OTHERS = 3


def _with_others(found: Verdict, crashes: Sequence[Happening], ends: Mapping[str, str]) -> Verdict:
    """Add the nodes that failed by themselves after the first one."""
    texts = [_with_tail(_crash(one).summary, ends.get(one.node, "")) for one in crashes]
    more = len(texts) - _MOST_OTHERS
    shown = [*texts[:_MOST_OTHERS], *([f"{more} more"] if more > 0 else [])]
    summary = "; then ".join((found.summary, *shown))
    return replace(found, summary=summary, others=tuple(one.node for one in crashes))


def _with_tail(summary: str, how: str) -> str:
    """Add the number of restarts, which only the runner's own text of that end has."""
    _, after, count = how.rpartition(" after ")
    return summary + (after + count if count.endswith(("restart", "restarts")) else "")


def _cause_of(life: Life, end: Happening) -> Cause:
    word = end.detail("cause")
    if word and word in list(Cause):
        return Cause(word)
    lost = life.last(*_LOSSES)
    if lost is not None:
        return Cause(lost.name)
    return Cause.NODE_FAILED if final_crashes(life) else Cause.UNIT_FAILED


def _is_kill_requested(life: Life, failure: Happening) -> bool:
    """Whether a stop was requested before the runner was killed, as life.kills finds it.

    A later request calls a restart off. systemd records the end before it runs what writes
    `failure`.
    """
    exited = life.last("process-exited")
    killed_us = min(failure.at_us, exited.at_us) if exited else failure.at_us
    return any(one.at_us <= killed_us for one in life.all("stop-asked", "unit-stopping"))


def _unit_failure(life: Life, end: Happening) -> Verdict:
    """Without an event of the runner, systemd's result is all that is known."""
    result = end.detail("unit_result")
    if result in UNIT_RESULTS:
        cause, words = UNIT_RESULTS[result]
        return _found(cause, words, end)
    exit = life.last("process-exited")
    if exit is not None and _is_oom(exit, life):
        return _found(Cause.OUT_OF_MEMORY, f"{RUNNER_KILLED}, out of memory", end)
    how = result_words(result) or (_exit_words(exit) if exit else "")
    said = how or f"the unit failed: {result or 'systemd does not say how'}"
    return _found(Cause.UNIT_FAILED, said, end)


def _is_oom(exit: Happening, life: Life) -> bool:
    """Whether the kernel killed that process because of memory: systemd has noticed it then."""
    is_kill = exit.detail("exit_status") in ("9", "KILL") and exit.detail("exit_code") == "killed"
    return is_kill and any(abs(exit.at_us - oom.at_us) <= _OOM_SPAN for oom in life.all("unit-oom"))


def _exit_words(exit: Happening) -> str:
    status = exit.detail("exit_status") or "unknown"
    if exit.detail("exit_code") != "exited":
        how = exit_of(-int(status)) if status.isdecimal() else f"signal {status}"
        return f"{RUNNER_KILLED} ({how})"
    refused = setup_failure(int(status)) if status.isdecimal() else ""
    return refused or f"the supervisor process failed (exit code {status})"


def _without_end(life: Life, facts: Facts) -> Verdict:
    if not life.happenings:
        return _found(Cause.NONE, "nothing is recorded about it")
    last = life.happenings[-1]
    if life.boot and facts.now_boot and life.boot != facts.now_boot:
        words = "the machine went down while it ran, without a shutdown"
        return _found(Cause.NO_END, words, last)
    return _found(Cause.NO_END, NO_END, last)


def stopped_by(life: Life, shutdowns: Sequence[int]) -> str:
    """Return who requested the end, if that is recorded."""
    asked = life.last("stop-asked")
    if asked is not None and asked.detail("by"):
        return asked.detail("by")
    order, job = life.last("dataflow-stopping"), life.last("unit-stopping")
    by = order.detail("by") if order else ""
    if by == "terminal":
        return "the end of its terminal"
    if by == HEAD:
        lost = life.last("machine-lost")
        return f"the loss of its head ({lost.detail('reason')})" if lost else "its head"
    moments = [one.at_us for one in (order, job) if one is not None]
    if any(life.began_us <= shutdown <= max(moments, default=0) for shutdown in shutdowns):
        return "the shutdown of the machine"
    if job is not None:
        return UNKNOWN_PERSON
    return f"the signal {by}" if by else "an unknown caller"


def _killed_at_stop(life: Life) -> str:
    """The nodes that had not ended when their time was up."""
    late = list(dict.fromkeys(one.node for one in life.all("node-stop-late")))
    if late:
        return f"; not stopped in their time: {', '.join(late)}"
    begin = life.last("dataflow-stopping")
    exits = (one for one in life.all("node-exited") if begin and one.at_us >= begin.at_us)
    nodes = [one.node for one in exits if parse_exit(one.detail("exit")) == KILLED]
    return f"; killed after the grace duration: {', '.join(nodes)}" if nodes else ""


def _starved(found: Verdict, life: Life) -> tuple[str, ...]:
    crash = next(
        (one for one in reversed(life.all(*NODE_FAILURES)) if one.node == found.node), None
    )
    return tuple(crash.detail("downstream").split()) if crash and found.node else ()


def restarts_of(chain: Sequence[Life]) -> list[Restart]:
    """The restarts before the end of the last life of a chain, oldest first."""
    found = []
    for life in chain:
        exits: dict[str, str] = {}
        for one in life.happenings:
            if one.name in NODE_END_EVENTS:
                exits[one.node] = one.detail("exit") or "ended"
            elif one.name == "node-restarted":
                found.append(Restart(one.at_us, "dora", one.node, exits.get(one.node, "unknown")))
            elif one.name == "unit-restart":
                reason = _end(life, Facts(), ()).summary
                found.append(Restart(one.at_us, "systemd", "", reason))
    return found


_FRESH = {
    "node-reloaded": (How.SWAP.value, How.REWIRE.value),
    "node-asked": (RESTART,),
    "reloaded": ("",),
    "machine-lost": ("",),
}
"""Events after which dora counts from zero, by what was done."""


def _counted(restarts: Sequence[Restart], life: Life, facts: Facts) -> list[Restart]:
    """The restarts that `list` counts: by systemd since the last reset, by dora in this run."""
    fresh = [one for one in life.all(*_FRESH) if _what(one) in _FRESH[one.name]]
    since = {one.node: one.at_us for one in fresh}
    begin = max(life.began_us, since.get("", 0))
    whole = [one for one in restarts if one.owner == "systemd"]
    left = len(whole) if facts.restarts is None else facts.restarts
    own = [one for one in restarts if one.node and one.at_us >= max(begin, since.get(one.node, 0))]
    return sorted([*whole[max(len(whole) - left, 0) :], *own], key=lambda one: one.at_us)


def _what(one: Happening) -> str:
    return one.detail("asked") if one.name == "node-asked" else one.detail("how")


_NO_NEWS = (
    *("node-ready", "node-exited", "unit-starting", "unit-started", "unit-stopping"),
    *("unit-stopped", "unit-succeeded", "unit-failed", "process-exited", "dataflow-stopping"),
    *("unit-oom", "cpu-throttled", "lines-suppressed"),
)

"""Verdicts: each cause from the records that tell it, and from any part of them."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.last_lines import Word
from dora_systemd.decisions.why.lives import (
    SHUTDOWN_MESSAGE,
    START_LIMIT_FUNCTION,
    UNIT_MESSAGES,
    Happening,
    Life,
    ended_nodes,
    find_lives,
    parse_happening,
    plain_text,
)
from dora_systemd.decisions.why.postmortem import UNKNOWN_PERSON, examine
from dora_systemd.decisions.why.report import Report, Subject, format_report, report_object
from dora_systemd.decisions.why.verdict import Facts, Verdict

Record = Mapping[str, Any]
IDS = {name: message_id for message_id, name in UNIT_MESSAGES.items()}
UUID = "550e8400-e29b-41d4-a716-446655440000"
SUBJECT = Subject(UUID, "robot", "dora-robot.service", "--system", "/srv/robot.yml", True)


def event(name: str, node: str = "", life: str = "1", **details: str) -> Record:
    own = {f"DORA_{key.upper()}": text for key, text in details.items()}
    record = {"DORA_EVENT": name, "_SYSTEMD_INVOCATION_ID": life, "_BOOT_ID": "b", **own}
    return {**record, "DORA_NODE": node} if node else record


def unit(name: str, life: str = "1", **fields: str) -> Record:
    return {"MESSAGE_ID": IDS[name], "INVOCATION_ID": life, "_BOOT_ID": "b", **fields}


LIMIT = {"CODE_FUNC": START_LIMIT_FUNCTION, "INVOCATION_ID": "1", "_BOOT_ID": "b"}
RUNS = (event("dataflow-starting"), event("dataflow-started"))
CRASH = event("node-crashed", "camera", exit="exit code 1", downstream="detector plot")
OOM = event(
    "node-oom", "camera", exit="out of memory, peak 300M, limit 300M", peak="314572800",
    limit="314572800", owner="node",
)  # fmt: skip
STOPPED = (event("dataflow-stopping", by="SIGTERM"), event("dataflow-stopped"))
JOB = unit("unit-stopping")


def failed(cause: str, reason: str = "r", nodes: str = "", life: str = "1") -> Record:
    return event("dataflow-failed", life=life, reason=reason, cause=cause, nodes=nodes)


def judge(*records: Record, facts: Facts | None = None, shutdowns: tuple[int, ...] = ()) -> Verdict:
    stamped = [{"__REALTIME_TIMESTAMP": str(n + 1), **one} for n, one in enumerate(records)]
    found = [one for one in map(parse_happening, stamped) if one]
    return examine(find_lives(found), facts or Facts(now_boot="b"), shutdowns)


NODE_FAILED = failed("node-failed", "node camera: exit code 1", "camera")
CASES: dict[str, tuple[tuple[Record, ...], str, Cause, str, str]] = {
    "exit code": (
        (*RUNS, CRASH, NODE_FAILED),
        *("Failed", Cause.NODE_FAILED, "camera", "node camera: exit code 1"),
    ),
    "restarts used up": (
        (*RUNS, CRASH, event("node-restarted", "camera"), CRASH,
         failed("node-failed", "node camera: exit code 1 after 1 restart", "camera")),
        *("Failed", Cause.NODE_FAILED, "camera", "node camera: exit code 1 after 1 restart"),
    ),
    "essential": (
        (*RUNS, CRASH, event("node-crashed", "plot", exit="signal SIGKILL"),
         failed("node-failed", "essential node camera: exit code 1 after 2 restarts", "camera")),
        *("Failed", Cause.NODE_FAILED, "camera"),
        "essential node camera: exit code 1 after 2 restarts",
    ),
    "essential, out of memory": (
        (*RUNS, OOM, failed("node-failed", "essential node camera: out of memory", "camera")),
        *("Failed", Cause.NODE_OUT_OF_MEMORY, "camera", "essential node camera: out of memory"),
    ),
    "the first to go is the one": (
        (*RUNS, event("node-crashed", "plot", exit="exit code 9"), CRASH,
         failed("node-failed", "node camera: x, node plot: exit code 9", "camera plot")),
        *("Failed", Cause.NODE_FAILED, "plot"),
        "node plot: exit code 9; then node camera: exit code 1",
    ),
    "what another one has taken along is not the one": (
        (*RUNS, event("node-crashed", "plot", exit="exit code 1 because node camera failed"), CRASH,
         failed("node-failed", "node camera: exit code 1, "
                "node plot: exit code 1 because node camera failed", "camera plot")),
        *("Failed", Cause.NODE_FAILED, "camera", "node camera: exit code 1"),
    ),
    "taken along, and dora has said so only at the end": (
        (*RUNS, event("node-crashed", "plot", exit="exit code 1"),
         event("node-crashed", "setup", exit="exit code 0 before it called dora"),
         failed("node-failed", "node setup: exit code 0 before it called dora, "
                "node plot: exit code 1 because node setup failed", "setup plot")),
        *("Failed", Cause.NODE_FAILED, "setup", "node setup: exit code 0 before it called dora"),
    ),
    "signal": (
        (*RUNS, event("node-crashed", "camera", exit="signal SIGSEGV"), NODE_FAILED),
        *("Failed", Cause.NODE_FAILED, "camera", "node camera: signal SIGSEGV"),
    ),
    "hung": (
        (*RUNS, event("node-crashed", "camera", exit="hung, unresponsive"), NODE_FAILED),
        *("Failed", Cause.NODE_HUNG, "camera", "node camera: hung, unresponsive"),
    ),
    "missed its watchdog": (
        (*RUNS, event("node-crashed", "camera", exit="hung, no WATCHDOG=1 for 5s"), NODE_FAILED),
        *("Failed", Cause.NODE_WATCHDOG, "camera", "node camera: hung, no WATCHDOG=1 for 5s"),
    ),
    "out of memory": (
        (*RUNS, OOM, NODE_FAILED),
        *("Failed", Cause.NODE_OUT_OF_MEMORY, "camera"),
        "node camera: out of memory, peak 300M, limit 300M",
    ),
    "start timeout": (
        (RUNS[0], failed("start-timeout", "node late was not ready within 2s", "late")),
        *("Failed", Cause.START_TIMEOUT, "late", "node late was not ready within 2s"),
    ),
    "bad dataflow": (
        (RUNS[0], failed("bad-dataflow", "cannot use x")),
        *("Failed", Cause.BAD_DATAFLOW, "", "cannot use x"),
    ),
    "another version has written the command line": (
        (RUNS[0], failed("other-version", "cannot read the runner's command line: x")),
        *("Failed", Cause.OTHER_VERSION, "", "cannot read the runner's command line: x"),
    ),
    "daemon": (
        (*RUNS, event("daemon-lost", exit="signal SIGKILL"), failed("daemon-lost", "gone")),
        *("Failed", Cause.DAEMON_LOST, "", "gone"),
    ),
    "daemon, without its cause": (
        (*RUNS, event("daemon-lost"), event("dataflow-failed", reason="gone")),
        *("Failed", Cause.DAEMON_LOST, "", "gone"),
    ),
    "the runner itself": (
        (*RUNS, failed("runner-broken", "the runner could not start the daemon: OSError: no")),
        *("Failed", Cause.RUNNER_BROKEN, ""),
        "the runner could not start the daemon: OSError: no",
    ),
    "watchdog": (
        (*RUNS, failed("watchdog", "its runner hung"), unit("unit-failed", UNIT_RESULT="watchdog")),
        *("Failed", Cause.WATCHDOG, "", "its runner hung"),
    ),
    "systemd could not begin": (
        (unit("process-exited", EXIT_CODE="exited", EXIT_STATUS="226"),
         unit("unit-failed", UNIT_RESULT="exit-code")),
        *("Failed", Cause.UNIT_FAILED, ""),
        "its sandbox could not be set up (exit code 226/NAMESPACE)",
    ),
    "systemd could not begin, for a reason of which we say nothing": (
        (unit("process-exited", EXIT_CODE="exited", EXIT_STATUS="225"),
         unit("unit-failed", UNIT_RESULT="exit-code")),
        *("Failed", Cause.UNIT_FAILED, ""),
        "systemd could not start its process (exit code 225/NETWORK)",
    ),
    "without a word of ours": (
        (unit("process-exited", EXIT_CODE="exited", EXIT_STATUS="1"),
         unit("unit-failed", UNIT_RESULT="exit-code")),
        *("Failed", Cause.UNIT_FAILED, ""),
        "the supervisor process failed (exit code 1)",
    ),
    "the kernel and its limit, and nothing of ours survived": (
        (*RUNS, unit("unit-oom"),
         unit("process-exited", EXIT_CODE="killed", EXIT_STATUS="9"),
         unit("unit-failed", UNIT_RESULT="signal")),
        *("Failed", Cause.OUT_OF_MEMORY, ""),
        "the supervisor process was killed, out of memory",
    ),
    "killed long after the kernel killed a process of it": (
        (*RUNS, unit("unit-oom"),
         unit("process-exited", EXIT_CODE="killed", EXIT_STATUS="9",
              __REALTIME_TIMESTAMP="20000000"),
         unit("unit-failed", UNIT_RESULT="signal", __REALTIME_TIMESTAMP="20000001")),
        *("Failed", Cause.UNIT_FAILED, ""),
        "the supervisor process was killed (signal SIGKILL)",
    ),
    "systemd lost patience": (
        (*RUNS, unit("unit-failed", UNIT_RESULT="timeout")),
        *("Failed", Cause.TIMEOUT, "", "it did not start or stop in time and was killed"),
    ),
    "finished": (
        (*RUNS, event("dataflow-finished"), unit("unit-succeeded")),
        *("Finished", Cause.FINISHED, "", "all nodes ended by themselves"),
    ),
    "stopped by signal": (
        (*RUNS, *STOPPED),
        *("Stopped", Cause.STOPPED, "", "stopped by the signal SIGTERM"),
    ),
    "stopped by systemctl": (
        (*RUNS, JOB, *STOPPED),
        *("Stopped", Cause.STOPPED, "", f"stopped by {UNKNOWN_PERSON}"),
    ),
    "stopped by root": (
        (*RUNS, event("stop-asked", life="session", by="root (doractl stop)"), JOB, *STOPPED),
        *("Stopped", Cause.STOPPED, "", "stopped by root (doractl stop)"),
    ),
    "stopped at once": (
        (*RUNS, event("stop-asked", life="session", by="root (doractl stop)"), JOB, STOPPED[0],
         failed("runner-killed", "the supervisor process was killed (SIGKILL)")),
        *("Stopped", Cause.STOPPED, "", "stopped by root (doractl stop); killed"),
    ),
    "killed, and its restart was called off": (
        (*RUNS, failed("runner-killed", "the supervisor process was killed (SIGKILL)"),
         event("stop-asked", life="session", by="root (doractl stop)"), JOB),
        *("Failed", Cause.RUNNER_KILLED, "", "the supervisor process was killed (SIGKILL)"),
    ),
    "killed, and its restart was called off before the end was recorded": (
        (*RUNS, unit("process-exited", EXIT_CODE="killed", EXIT_STATUS="9"),
         event("stop-asked", life="session", by="root (doractl stop)"),
         failed("runner-killed", "the supervisor process was killed (SIGKILL)"), JOB),
        *("Failed", Cause.RUNNER_KILLED, "", "the supervisor process was killed (SIGKILL)"),
    ),
    "stopped at once, as systemd records it": (
        (*RUNS, event("stop-asked", life="session", by="root (doractl stop)"),
         unit("process-exited", EXIT_CODE="killed", EXIT_STATUS="9"),
         failed("runner-killed", "the supervisor process was killed (SIGKILL)"), JOB),
        *("Stopped", Cause.STOPPED, "", "stopped by root (doractl stop); killed"),
    ),
    "stopped by systemctl, then killed": (
        (*RUNS, JOB, STOPPED[0], unit("process-exited", EXIT_CODE="killed", EXIT_STATUS="9"),
         failed("runner-killed", "the supervisor process was killed (SIGKILL)")),
        *("Stopped", Cause.STOPPED, "", f"stopped by {UNKNOWN_PERSON}; killed"),
    ),
    "crashed during a stop": (
        (*RUNS, event("stop-asked", life="session", by="root (doractl stop)"), JOB, STOPPED[0],
         failed("runner-killed", "the supervisor process was killed (SIGSEGV)")),
        *("Failed", Cause.RUNNER_KILLED, "", "the supervisor process was killed (SIGSEGV)"),
    ),
    "stopped, and a node had to be killed": (
        (*RUNS, event("node-exited", "camera", exit="signal SIGKILL"), JOB, STOPPED[0],
         event("node-exited", "plot"), event("node-exited", "deaf", exit="signal SIGKILL"),
         STOPPED[1]),
        *("Stopped", Cause.STOPPED, ""),
        f"stopped by {UNKNOWN_PERSON}; killed after the grace duration: deaf",
    ),
    "stopped, and a node used up its own time": (
        (*RUNS, JOB, STOPPED[0], event("node-stop-late", "recorder"),
         event("node-exited", "recorder", exit="signal SIGKILL"), STOPPED[1]),
        *("Stopped", Cause.STOPPED, ""),
        f"stopped by {UNKNOWN_PERSON}; not stopped in their time: recorder",
    ),
    "stopped with its terminal": (
        (*RUNS, event("dataflow-stopping", by="terminal"), event("dataflow-stopped")),
        *("Stopped", Cause.STOPPED, ""),
        "stopped by the end of its terminal",
    ),
    "stopped before its runner could listen": (
        (RUNS[0], JOB, unit("unit-succeeded")),
        *("Stopped", Cause.STOPPED, "", f"stopped by {UNKNOWN_PERSON}"),
    ),
    "no end": (
        RUNS,
        *("Failed", Cause.NO_END, ""),
        "its end is not recorded: it was killed, or the machine went down",
    ),
    "nothing at all": ((), *("Stopped", Cause.NONE, "", "nothing is recorded about it")),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_cause(case: str) -> None:
    records, status, cause, node, summary = CASES[case]
    verdict = judge(*records)
    assert (verdict.status, verdict.cause, verdict.node) == (status, cause, node)
    assert verdict.summary == summary
    assert verdict.is_failure == (status == "Failed")
    text = format_report(Report(SUBJECT, verdict))
    assert text.startswith(f"robot: {status}\n")
    assert summary in text


def test_what_a_failed_node_says() -> None:
    verdict = judge(*RUNS, CRASH, NODE_FAILED)
    assert verdict.starved == ("detector", "plot")
    assert (verdict.began_us, verdict.at_us) == (1, 3)
    text = format_report(Report(SUBJECT, verdict))
    assert "Starved:  detector, plot" in text
    assert "doractl restart robot" in text


def test_memory() -> None:
    text = format_report(Report(SUBJECT, judge(*RUNS, OOM, NODE_FAILED)))
    assert "Memory:   peak 300M, limit 300M\n" in text
    assert "doractl set robot --node camera:memory_limit=SIZE" in text


def test_memory_of_the_dataflow() -> None:
    end = {**failed("out-of-memory"), "DORA_OWNER": "dataflow", "DORA_LIMIT": "5242880"}
    text = format_report(Report(SUBJECT, judge(*RUNS, end)))
    assert "Memory:   limit 5M of the dataflow\n" in text
    assert "doractl set robot --memory-limit SIZE" in text


def test_memory_that_is_no_number() -> None:
    crash = {**OOM, "DORA_PEAK": "²", "DORA_LIMIT": "many"}
    text = format_report(Report(SUBJECT, judge(*RUNS, crash, NODE_FAILED)))
    assert "Memory:" not in text


def test_power_cut() -> None:
    verdict = judge(*RUNS, facts=Facts(now_boot="another"))
    assert verdict.cause is Cause.NO_END
    assert verdict.summary.startswith("the machine went down while it ran")


def test_shutdown() -> None:
    # Started at 1, shutdown at 2, stopping at 3.
    assert judge(*RUNS, *STOPPED, shutdowns=(2,)).stopped_by == "the shutdown of the machine"
    assert judge(*RUNS, *STOPPED, shutdowns=(5,)).stopped_by == "the signal SIGTERM"


def test_restarts_of_the_whole_and_the_limit_of_them() -> None:
    lost = (event("daemon-lost"), failed("daemon-lost", "gone"))
    verdict = judge(
        event("dataflow-starting", life="0"),
        failed("runner-killed", "another matter", life="0"),
        *(*RUNS, *lost, unit("unit-restart", N_RESTARTS="1")),
        event("dataflow-starting", life="2"),
        event("daemon-lost", life="2"),
        failed("daemon-lost", "gone again", life="2"),
        {**LIMIT, "INVOCATION_ID": "2"},
    )
    assert [(one.owner, one.reason) for one in verdict.restarts] == [("systemd", "gone")]
    assert verdict.is_given_up
    assert (verdict.summary, verdict.invocation) == ("gone again", "2")
    text = format_report(Report(SUBJECT, verdict))
    assert (verdict.before, verdict.before_us) == ("another matter", 2)
    assert "Before:   another matter (" in text
    assert "Restarts: dataflow 1 (gone)" in text
    assert "systemd has stopped restarting it" in text


def test_a_restart_that_the_runner_refuses_is_none() -> None:
    spent = "1 automatic restart within 10min did not help"
    lives = (
        *(*RUNS, event("daemon-lost"), failed("daemon-lost", "gone"), unit("unit-restart")),
        *(event("dataflow-starting", life="2"), failed("daemon-lost", "again", life="2")),
        unit("unit-restart", "2"),
        failed("restarts-spent", spent, life="3"),
    )
    verdict = judge(*lives, unit("unit-failed", "3"), facts=Facts("Failed", restarts=2))
    assert (verdict.status, verdict.cause) == ("Failed", Cause.DAEMON_LOST)
    assert (verdict.summary, verdict.invocation) == ("again", "2")
    assert verdict.is_given_up
    assert [one.reason for one in verdict.restarts] == ["gone"]
    alone = judge(*lives[-1:], facts=Facts("Failed", restarts=2))
    assert (alone.cause, alone.summary) == (Cause.RESTARTS_SPENT, spent)


def test_restarts_are_those_that_list_counts() -> None:
    def restarted(node: str, life: str) -> Record:
        return event("node-restarted", node, life)

    first = (event("dataflow-starting"), restarted("camera", "1"), unit("unit-restart"))
    second = (event("dataflow-starting", life="2"), unit("unit-restart", "2"))
    third = (event("dataflow-starting", life="3"), restarted("camera", "3"), restarted("plot", "3"))
    chain = (*first, *second, *third)

    def counted(*more: Record, restarts: int | None = None) -> str:
        facts = Facts("Running", restarts=restarts)
        verdict = judge(*chain, *more, facts=facts)
        return " ".join(one.node or one.owner for one in verdict.restarts)

    assert counted() == "systemd systemd camera plot"
    assert counted(restarts=2) == counted(restarts=9) == counted()
    assert counted(restarts=1) == "systemd camera plot"
    assert counted(restarts=0) == "camera plot"
    fresh = event("node-reloaded", "plot", "3", how="reloaded")
    assert counted(fresh, restarts=0) == "camera"
    limits = event("node-reloaded", "plot", "3", how="given new limits")
    assert counted(limits, restarts=0) == "camera plot"
    asked = event("node-asked", "plot", "3", asked="restart")
    assert counted(asked, restarts=0) == "camera"
    stopped = event("node-asked", "plot", "3", asked="stop")
    assert counted(stopped, restarts=0) == "camera plot"
    again = (event("reloaded", life="3"), restarted("plot", "3"))
    assert counted(*again, restarts=0) == "plot"


def test_running_degraded_and_restarting() -> None:
    again = (CRASH, event("node-restarted", "camera"))
    verdict = judge(*RUNS, *again, facts=Facts("Running", "2/2 nodes running"))
    assert (verdict.now, verdict.node, verdict.is_failure) == ("2/2 nodes running", "", False)
    assert [(one.node, one.reason) for one in verdict.restarts] == [("camera", "exit code 1")]
    gone = Facts("Degraded", "1/2", {"camera": "exit code 1 after 2 restarts"})
    verdict = judge(*RUNS, CRASH, facts=gone)
    assert (verdict.status, verdict.node, verdict.is_failure) == ("Degraded", "camera", True)
    text = format_report(Report(SUBJECT, verdict))
    assert "Why:      node camera: exit code 1 after 2 restarts\n  Now:      1/2\n" in text
    assert "camera stays down until doractl restart robot;" in text
    text = format_report(Report(SUBJECT, verdict, is_held=True))
    assert "  fix camera, and save it\n  camera stays down until its file is saved, " in text
    assert "doractl reload robot --node camera;" in text
    assert "doractl restart" not in text
    waiting = Facts("Running", "1/2", restarting=("camera",))
    verdict = judge(*RUNS, CRASH, facts=waiting)
    assert (verdict.node, verdict.is_passing, verdict.is_failure) == ("camera", True, False)
    assert "dora restarts camera automatically" in format_report(Report(SUBJECT, verdict))
    loop = format_report(Report(SUBJECT, judge(*RUNS, *again, CRASH, facts=waiting)))
    assert "  fix camera\n  dora restarts camera automatically, and so finds it fixed" in loop
    said = (Word(1, "camera", "SyntaxError: invalid syntax"),)
    assert "  fix camera\n" in format_report(Report(SUBJECT, verdict, said))
    facts = Facts("Restarting")
    verdict = judge(*RUNS, failed("daemon-lost", "gone"), unit("unit-restart"), facts=facts)
    assert (verdict.status, verdict.summary) == ("Restarting", "gone")
    assert "systemd restarts it automatically" in format_report(Report(SUBJECT, verdict))


def test_two_that_fail_for_different_reasons_have_both_their_names() -> None:
    crashes = (CRASH, event("node-crashed", "plot", exit="exit code 3"))
    ends = {"camera": "exit code 1", "plot": "exit code 3 after 1 restart"}
    down = Facts("Degraded", "1/3", ends)
    for verdict in (
        judge(*RUNS, *crashes, facts=down),
        judge(*RUNS, *crashes, failed("node-failed", "node plot: exit code 3 after 1 restart, "
                                      "node camera: exit code 1", "plot camera")),
    ):  # fmt: skip
        assert (verdict.node, verdict.others) == ("camera", ("plot",))
        first, second = "node camera: exit code 1", "node plot: exit code 3 after 1 restart"
        assert verdict.summary == f"{first}; then {second}"
        text = format_report(Report(SUBJECT, verdict))
        assert "fix plot as well; doractl logs robot --node plot has its last lines" in text
    away = judge(*RUNS, *crashes, facts=down)
    assert "camera, plot stay down until" in format_report(Report(SUBJECT, away))
    many = [event("node-crashed", f"n{n}", exit="exit code 1") for n in range(9)]
    reason = ", ".join(f"node n{n}: exit code 1" for n in range(9))
    nodes = " ".join(f"n{n}" for n in range(9))
    verdict = judge(*RUNS, *many, failed("node-failed", reason, nodes))
    assert verdict.summary.endswith("; then node n3: exit code 1; then 5 more")


def test_a_restart_that_is_called_off_says_nothing() -> None:
    """`list --all` knows the runner's own events alone, and says the same."""
    lost = (*RUNS, failed("coordinator-lost", "gone"), unit("unit-failed"), unit("unit-restart"))
    called_off = [
        *(unit("unit-starting", "2"), event("stop-asked", life="2", by="root")),
        *(unit("unit-stopping", "2"), unit("unit-succeeded", "2"), unit("unit-stopped", "2")),
    ]
    verdict = judge(*lost, *called_off)
    assert (verdict.status, verdict.summary) == ("Failed", "gone")
    known = judge(*lost, *called_off, facts=Facts("Stopped"))  # `list` says what systemd does
    assert (known.status, known.summary) == ("Stopped", "stopped by root")
    begun = [*called_off[:2], event("dataflow-starting", life="2"), *called_off[2:]]
    assert judge(*lost, *begun).status == "Stopped"
    assert judge(*lost, unit("unit-starting", "2"), facts=Facts("Starting")).status == "Starting"


def test_one_screen() -> None:
    crashes = [one for _ in range(50) for one in (CRASH, event("node-restarted", "camera"))]
    verdict = judge(*RUNS, *crashes, CRASH, NODE_FAILED)
    words = tuple(Word(n, "camera", "x" * 200 + "\x1b[31m") for n in range(20))
    budget = {"used": 1, "max": 5, "next_us": None, "resets_us": 60_000_000}
    text = format_report(Report(SUBJECT, verdict, words, budget), width=80)
    lines = text.splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) == 80
    assert "\x1b" not in text
    assert "... 97 more ..." in text
    colored = format_report(Report(SUBJECT, verdict, words, budget), 80, want_colors=True)
    assert colored.startswith("\x1b[1mrobot\x1b[0m: \x1b[31mFailed\x1b[0m\n"), "as in list"
    assert re.sub(r"\x1b\[\d*m", "", colored) == text


def test_a_path_is_never_broken() -> None:
    path = "/srv/" + "a-long-name/" * 8 + "robot.yml"
    text = format_report(Report(replace(SUBJECT, file=path), Verdict("Failed", Cause.REFUSED)), 60)
    assert f"\n            {path}\n" in text
    assert f"  fix\n  {path},\n  then run: " in text


@pytest.mark.parametrize("width", [60, 80, 200])
def test_what_to_do_is_whole_at_any_width(width: int) -> None:
    verdict = judge(*RUNS, OOM, NODE_FAILED)
    subject = replace(SUBJECT, name="a" * 150)
    words = tuple(Word(n, "camera", "x" * 300) for n in range(20))
    text = format_report(Report(subject, verdict, words), width)
    lines = text.splitlines()
    assert not [line for line in lines if len(line) > width and subject.name not in line]
    assert lines[0].endswith(": Failed")
    whole = " ".join(text.partition("What to do:")[2].split())
    assert "find the leak in camera, or run: doractl set" in whole
    assert "--node camera:memory_limit=SIZE" in whole
    assert UUID in text


def test_values_of_fields() -> None:
    assert plain_text([104, 105, 255]) == "hi�"
    assert plain_text(["a", "b"]) == "b"
    assert plain_text(None) == plain_text([]) == ""
    assert parse_happening({"MESSAGE": "a line"}) is None
    assert parse_happening({"MESSAGE_ID": SHUTDOWN_MESSAGE}) is None


@pytest.mark.parametrize(
    ("exit", "owner", "words"),
    [
        ("signal SIGSEGV", "", "coredumpctl info 7"),
        ("signal SIGKILL", "", "journalctl -k"),
        ("out of memory: x", "dataflow", "doractl set robot --memory-limit SIZE"),
        ("out of memory: x", "machine", "the machine is short of memory"),
        ("exit code 1", "", "fix camera"),
        ("exit code 0 before it called dora", "", "have camera call Node()"),
    ],
)
def test_remedies(exit: str, owner: str, words: str) -> None:
    name = "node-oom" if owner else "node-crashed"
    crash = event(name, "camera", exit=exit, owner=owner, node_pid="7")
    text = format_report(Report(SUBJECT, judge(*RUNS, crash, NODE_FAILED)))
    assert words in text.partition("What to do:")[2]


def test_what_is_frozen_has_to_be_thawed() -> None:
    text = format_report(Report(SUBJECT, judge(*RUNS, facts=Facts("Frozen", "2/2 nodes running"))))
    assert "systemctl --system thaw dora-robot.service" in text.partition("What to do:")[2]


def test_one_that_is_gone_is_started_anew() -> None:
    gone = Subject(UUID, "robot", "dora-robot.service", "--user")
    text = format_report(Report(gone, judge(*RUNS, CRASH, NODE_FAILED)))
    assert "fix camera, then run: doractl start FILE --name robot" in text


SEVERAL = [record for records, *_ in CASES.values() for record in records]
VALUES = st.one_of(
    st.none(), st.text(max_size=9), st.integers(), st.lists(st.integers(), max_size=3)
)


@st.composite
def broken(draw: st.DrawFn) -> Record:
    record = dict(draw(st.sampled_from([*SEVERAL, LIMIT])))
    for key in draw(st.lists(st.sampled_from(sorted(record)), max_size=4)):
        record.pop(key, None)
    record |= draw(st.dictionaries(st.sampled_from(sorted(SEVERAL[2])), VALUES, max_size=2))
    return record


FACTS = st.builds(
    Facts,
    st.sampled_from(["", "Running", "Degraded", "Restarting", "Failed", "Stopped", "Starting"]),
    st.text(max_size=5),
    st.dictionaries(st.sampled_from(["camera", "x"]), st.text(max_size=3), max_size=2),
)


@given(st.lists(broken(), max_size=12), FACTS, st.lists(st.integers(), max_size=2))
def test_whatever_is_missing_there_is_a_verdict(
    records: list[Record], facts: Facts, shutdowns: list[int]
) -> None:
    found: list[Happening] = [one for one in map(parse_happening, records) if one]
    verdict = examine(find_lives(found), facts, shutdowns)
    report = Report(SUBJECT, verdict)
    assert format_report(report, 80, want_colors=True)
    row = DataflowRow(SUBJECT.uuid, SUBJECT.name, SUBJECT.unit, "Stopped")
    assert report_object(report, row)["status"] == verdict.status


def life(*events: tuple[str, str] | tuple[str, str, str]) -> Life:
    """Each event: name, node and exit."""
    found = []
    for at_us, (name, node, *exit) in enumerate(events, 1):
        found.append(Happening(name, at_us, node, details={"exit": exit[0]} if exit else {}))
    return Life(tuple(found))


def states(*events: tuple[str, str] | tuple[str, str, str]) -> dict[str, tuple[str, str]]:
    return {row.node: (row.state, row.exit) for row in ended_nodes(life(*events))}


def test_how_each_node_was_left() -> None:
    found = states(
        ("node-ready", "camera"),
        ("node-ready", "plot"),
        ("node-ready", "arm"),
        ("node-crashed", "camera", "exit code 3"),
        ("node-exited", "plot"),
        ("dataflow-stopping", ""),
        ("node-exited", "arm", "exit code 1"),
    )
    assert found == {
        "camera": ("failed", "exit code 3"),
        "plot": ("finished", ""),
        "arm": ("stopped", "exit code 1"),
    }


def test_a_node_that_somebody_had_stopped() -> None:
    asked = Happening("node-asked", 2, "plot", details={"asked": "stop"})
    exited = Happening("node-exited", 3, "plot", details={"asked": "stop", "exit": "exit code 3"})
    again = Happening("node-asked", 4, "plot", details={"asked": "restart"})
    ready = (Happening("node-ready", 1, "plot"),)
    (row,) = ended_nodes(Life((*ready, asked, exited, again)))
    assert (row.state, row.exit) == ("stopped", "exit code 3")
    (row,) = ended_nodes(Life((*ready, asked)))
    assert row.state == "stopped"


def test_restarts_are_counted_and_the_last_exit_stays() -> None:
    (row,) = ended_nodes(
        life(
            ("node-ready", "a"),
            ("node-crashed", "a", "exit code 1"),
            ("node-restarted", "a"),
            ("node-ready", "a"),
            ("node-oom", "a", "out of memory"),
        )
    )
    assert (row.state, row.restarts, row.exit, row.since) == ("failed", 1, "out of memory", 5)


def test_nothing_runs_when_the_unit_has_ended() -> None:
    rows = ended_nodes(life(("node-ready", "a"), ("node-restarted", "b"), ("unit-failed", "")))
    assert {row.node: row.state for row in rows} == {"a": "stopped", "b": "stopped"}
    assert {row.since for row in rows} == {3}


def test_nodes_that_never_became_ready() -> None:
    end = Happening("dataflow-failed", 9, details={"nodes": "late other"})
    rows = ended_nodes(Life((end,)))
    assert [(row.node, row.state) for row in rows] == [("late", "failed"), ("other", "failed")]
    assert ended_nodes(Life()) == ()

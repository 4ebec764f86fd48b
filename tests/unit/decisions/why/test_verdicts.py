"""Verdicts about machines, nodes that say nothing, and records that say little."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.life.causes import NO_END, Cause
from dora_systemd.decisions.views.dataflows import WAITING
from dora_systemd.decisions.why.lives import (
    UNIT_MESSAGES,
    Happening,
    Life,
    ended_nodes,
    find_lives,
    parse_happening,
    parse_number,
    plain_text,
    with_restarts,
)
from dora_systemd.decisions.why.postmortem import (
    UNKNOWN_PERSON,
    ended_word,
    examine,
    final_crashes,
    restarts_of,
    stopped_by,
)
from dora_systemd.decisions.why.remedies import remedy_of
from dora_systemd.decisions.why.verdict import Facts, Verdict
from tests.unit.decisions.why.test_postmortem import (
    CRASH,
    JOB,
    NODE_FAILED,
    OOM,
    RUNS,
    STOPPED,
    Record,
    event,
    failed,
    judge,
    unit,
)

GPU = event("machine-lost", machine="gpu", reason="its cable is out")
CAM = event("machine-lost", machine="cam", reason="it rebooted")


@pytest.mark.parametrize(
    ("records", "cause", "summary", "at_us"),
    [
        (RUNS, Cause.NONE, "", 0),
        ((*RUNS, GPU), Cause.MACHINE_LOST, "machine gpu: its cable is out", 3),
        ((*RUNS, GPU, CAM), Cause.MACHINE_LOST, "machine cam: it rebooted", 4),
        (
            (*RUNS, GPU, unit("unit-restart"), event("dataflow-starting", life="2")),
            *(Cause.MACHINE_LOST, "machine gpu: its cable is out", 3),
        ),
        ((*RUNS, GPU, event("dataflow-starting", life="2")), Cause.NONE, "", 0),
    ],
)
def test_it_waits_for_a_machine(
    records: tuple[Record, ...], cause: Cause, summary: str, at_us: int
) -> None:
    """Which was there before; the loss in an earlier, unconnected life is no news."""
    verdict = judge(*records, facts=Facts(WAITING, "waits for gpu", is_gathering=True))
    assert (verdict.cause, verdict.summary, verdict.at_us) == (cause, summary, at_us)
    assert (verdict.status, verdict.now) == (WAITING, "waits for gpu")
    assert verdict.details.get("machine") == (
        summary.split(":")[0].removeprefix("machine ") or None
    )


BY_HEAD = event("dataflow-stopping", by="head")


@pytest.mark.parametrize(
    ("records", "by"),
    [
        ((BY_HEAD,), "its head"),
        ((GPU, BY_HEAD), "the loss of its head (its cable is out)"),
        ((GPU, BY_HEAD, JOB), "the loss of its head (its cable is out)"),
        ((event("dataflow-stopping", by="SIGINT"),), "the signal SIGINT"),
        ((event("dataflow-stopping", by="SIGINT"), JOB), UNKNOWN_PERSON),
        ((event("dataflow-stopping"),), "an unknown caller"),
        ((event("stop-asked", by=""), JOB), UNKNOWN_PERSON),
        ((event("stop-asked", by="a"), event("stop-asked", by="b"), JOB), "b"),
    ],
)
def test_who_stopped_it(records: tuple[Record, ...], by: str) -> None:
    verdict = judge(*RUNS, *records, event("dataflow-stopped"))
    assert verdict.stopped_by == by
    assert verdict.summary == f"stopped by {by}"


@pytest.mark.parametrize(
    ("shutdown", "by"),
    [(1, UNKNOWN_PERSON), (2, "shutdown"), (7, "shutdown"), (8, UNKNOWN_PERSON)],
)
def test_a_shutdown_of_the_machine_stops_what_runs_then(shutdown: int, by: str) -> None:
    life = Life((Happening("dataflow-starting", 2), Happening("unit-stopping", 7)))
    wanted = "the shutdown of the machine" if by == "shutdown" else by
    assert stopped_by(life, (shutdown,)) == wanted


@pytest.mark.parametrize(
    ("silent", "node", "summary", "at_us"),
    [
        ({"camera": "no image for 2s"}, "camera", "node camera: no image for 2s", 5),
        (
            {"plot": "no line for 2s, starved of camera/image"},
            *(
                "camera",
                "node camera: sends nothing; plot: no line for 2s, starved of camera/image",
            ),
            3,
        ),
        ({"arm": "no move for 2s"}, "arm", "node arm: no move for 2s", 0),
    ],
)
def test_a_node_that_sends_nothing(
    silent: dict[str, str], node: str, summary: str, at_us: int
) -> None:
    """Who sends nothing to a silent node is to blame."""
    said = (event("node-silent", "plot"), event("node-silent", "camera"))
    twice = (said[0], said[1], event("node-silent", "camera"))
    verdict = judge(*RUNS, *twice, facts=Facts("Running", "2/2", silent=silent))
    assert (verdict.cause, verdict.node, verdict.summary) == (Cause.NODE_SILENT, node, summary)
    assert verdict.at_us == at_us
    assert verdict.is_failure
    assert not verdict.is_away, "it is there"


def test_the_node_that_failed_for_good_comes_before_one_that_is_silent() -> None:
    facts = Facts("Degraded", "1/3", {"camera": "gone"}, ("plot",), silent={"arm": "x"})
    plot = event("node-crashed", "plot", exit="exit code 2")
    verdict = judge(*RUNS, plot, CRASH, facts=facts)
    assert (verdict.node, verdict.summary, verdict.is_passing) == (
        *("camera", "node camera: gone"),
        False,
    )
    assert verdict.is_away
    verdict = judge(*RUNS, plot, CRASH, facts=replace(facts, failed={}))
    assert (verdict.node, verdict.is_passing) == ("plot", True)


def test_what_the_journal_does_not_say_of_a_crash() -> None:
    crash = event("node-crashed", "camera")
    verdict = judge(*RUNS, crash, failed("node-failed", "node camera: x", "camera"))
    assert verdict.summary == "node camera: ended, how is not recorded"
    verdict = judge(*RUNS, failed("node-failed", "", "camera plot"))
    assert (verdict.summary, verdict.node) == ("for a reason that is not recorded", "camera")
    silent = event("node-crashed", "camera", exit="silent, no image for 2s")
    assert judge(*RUNS, silent, NODE_FAILED).cause is Cause.NODE_SILENT


@pytest.mark.parametrize(
    ("reason", "summary"),
    [
        ("node camera: x after 2 restarts", "node camera: exit code 1 after 2 restarts"),
        (
            "node plot: y, node camera: x after 1 restart",
            "node camera: exit code 1 after 1 restart",
        ),
        ("node plot: y after 3 restarts, node camera: x", "node camera: exit code 1"),
        ("node camera: x after all", "node camera: exit code 1"),
        ("node camera2: x after 2 restarts", "node camera: exit code 1"),
        ("", "node camera: exit code 1"),
    ],
)
def test_the_number_of_restarts_is_that_of_the_node(reason: str, summary: str) -> None:
    verdict = judge(*RUNS, CRASH, failed("node-failed", reason, "camera plot"))
    assert verdict.summary == summary


@pytest.mark.parametrize(
    ("more", "cause"),
    [
        ((), Cause.UNIT_FAILED),
        ((CRASH,), Cause.NODE_FAILED),
        ((CRASH, event("coordinator-lost")), Cause.COORDINATOR_LOST),
        ((CRASH, GPU), Cause.MACHINE_LOST),
    ],
)
@pytest.mark.parametrize("word", ["", "of-a-later-version"])
def test_a_cause_that_has_no_word(more: tuple[Record, ...], cause: Cause, word: str) -> None:
    end = event("dataflow-failed", reason="r", cause=word)
    assert judge(*RUNS, *more, end).cause is cause


def test_the_loss_says_more_than_the_end() -> None:
    verdict = judge(*RUNS, GPU, failed("machine-lost", "gone"))
    assert (verdict.at_us, verdict.details["machine"]) == (3, "gpu")
    verdict = judge(*RUNS, GPU, failed("no-answer", "gone"))
    assert verdict.at_us == 4
    assert judge(*RUNS, failed("machine-lost", "gone")).at_us == 3


@pytest.mark.parametrize(
    ("code", "status", "words"),
    [
        ("killed", "9", "the supervisor process was killed (signal SIGKILL)"),
        ("killed", "TERM", "the supervisor process was killed (signal TERM)"),
        ("dumped", "11", "the supervisor process was killed (signal SIGSEGV)"),
        ("killed", "", "the supervisor process was killed (signal unknown)"),
        ("exited", "", "the supervisor process failed (exit code unknown)"),
        ("exited", "3", "the supervisor process failed (exit code 3)"),
    ],
)
def test_how_the_supervisor_process_ended(code: str, status: str, words: str) -> None:
    exited = unit("process-exited", EXIT_CODE=code, EXIT_STATUS=status)
    assert judge(*RUNS, exited, unit("unit-failed", UNIT_RESULT="signal")).summary == words


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ("", "the unit failed: systemd does not say how"),
        ("new-result", "the unit failed: new-result"),
        ("resources", "systemd could not set it up"),
        ("protocol", "its supervisor process ended without a message"),
    ],
)
def test_what_systemd_says_of_a_unit(result: str, words: str) -> None:
    verdict = judge(*RUNS, unit("unit-failed", UNIT_RESULT=result))
    assert (verdict.cause, verdict.summary) == (Cause.UNIT_FAILED, words)


@pytest.mark.parametrize(
    ("code", "status", "oom_us", "is_oom"),
    [
        ("killed", "9", 20_000_000, True),
        ("killed", "KILL", 20_000_000, True),
        ("killed", "KILL", 40_000_000, True),
        ("killed", "KILL", 40_000_001, False),
        ("killed", "KILL", 19_999_999, False),
        ("killed", "15", 30_000_000, False),
        ("exited", "9", 30_000_000, False),
    ],
)
def test_the_kernel_killed_it_because_of_memory(
    code: str, status: str, oom_us: int, is_oom: bool
) -> None:
    at = {"__REALTIME_TIMESTAMP": "30000000"}
    verdict = judge(
        *RUNS,
        unit("unit-oom", __REALTIME_TIMESTAMP=str(oom_us)),
        unit("process-exited", EXIT_CODE=code, EXIT_STATUS=status, **at),
        unit("unit-failed", UNIT_RESULT="signal", **at),
    )
    assert (verdict.cause is Cause.OUT_OF_MEMORY) == is_oom
    assert verdict.summary.endswith("out of memory") == is_oom


@pytest.mark.parametrize(
    ("boot", "now", "is_cut"),
    [("b", "c", True), ("b", "b", False), ("", "c", False), ("b", "", False)],
)
def test_a_power_cut_is_told_by_two_boots(boot: str, now: str, is_cut: bool) -> None:
    runs = [{**one, "_BOOT_ID": boot} for one in RUNS]
    verdict = judge(*runs, facts=Facts(now_boot=now))
    cut = "the machine went down while it ran, without a shutdown"
    assert (verdict.summary, verdict.at_us) == (cut if is_cut else NO_END, 2)


def test_what_a_start_that_is_held_back_has_to_do_with_its_past() -> None:
    """Nothing: systemd has not begun it."""
    facts = Facts("Starting", "waits for the network", is_held=True)
    verdict = judge(*RUNS, CRASH, NODE_FAILED, facts=facts)
    assert (verdict.status, verdict.cause, verdict.began_us) == ("Starting", Cause.NONE, 0)
    assert verdict.before == "node camera: exit code 1"
    assert verdict.timeline == ()


@pytest.mark.parametrize(
    ("names", "known", "word"),
    [
        ((), "", "Stopped"),
        ((), "Frozen", "Frozen"),
        (("node-ready",), "Frozen", "Failed"),
        (("unit-succeeded",), "", "Stopped"),
        (("dataflow-finished", "unit-succeeded"), "", "Finished"),
        (("dataflow-failed", "unit-succeeded"), "", "Failed"),
        (("dataflow-finished",), "", "Finished"),
        (("dataflow-finished", "unit-failed"), "", "Failed"),
    ],
)
def test_the_word_for_an_end(names: tuple[str, ...], known: str, word: str) -> None:
    assert ended_word(Life(tuple(map(Happening, names))), known) == word


def test_what_is_news() -> None:
    quiet = ("node-ready", "node-exited", "cpu-throttled", "lines-suppressed")
    records = (*RUNS, *(event(name, "a") for name in quiet), CRASH, *STOPPED)
    assert [one.name for one in judge(*records).timeline] == [
        *("dataflow-starting", "dataflow-started", "node-crashed", "dataflow-stopped")
    ]


def test_what_the_verdict_hands_on() -> None:
    facts = Facts("Degraded", "1/2", stopped={"plot": "root"}, policy="always")
    verdict = judge(*RUNS, OOM, facts=facts)
    assert (verdict.stopped, verdict.policy) == ({"plot": "root"}, "always")
    assert verdict.nodes == (), "the runner's table has them"
    assert [row.node for row in judge(*RUNS, OOM).nodes] == ["camera"]
    assert judge(*RUNS, OOM).now == ""


def test_the_last_crash_of_each_node() -> None:
    life = Life(tuple(
        Happening(name, at_us, node)
        for name, at_us, node in (
            *(("node-crashed", 1, "a"), ("node-oom", 2, "b"), ("node-exited", 3, "c")),
            ("node-ended", 4, "a"),
        )
    ))  # fmt: skip
    assert [(one.node, one.at_us) for one in final_crashes(life)] == [("b", 2), ("a", 4)]


def test_why_each_restart_was() -> None:
    first = Life((
        *(Happening("node-restarted", 1, "a"), Happening("node-exited", 2, "a")),
        *(Happening("node-restarted", 3, "a"), Happening("node-crashed", 4, "b")),
        Happening("node-oom", 5, "a", details={"exit": "out of memory"}),
        *(Happening("node-restarted", 6, "a"), Happening("unit-restart", 7)),
    ))  # fmt: skip
    assert [(one.at_us, one.owner, one.node, one.reason) for one in restarts_of([first])] == [
        (1, "dora", "a", "unknown"),
        (3, "dora", "a", "ended"),
        (6, "dora", "a", "out of memory"),
        (7, "systemd", "", NO_END),
    ]
    assert restarts_of([]) == []


def test_a_life() -> None:
    happenings = (
        *(Happening("x"), Happening("unit-starting", 5, invocation="1", boot="a")),
        *(Happening("dataflow-starting", 6, invocation="2", boot="b"), Happening("x", 9)),
    )
    life = Life(happenings)
    assert (life.began_us, life.invocation, life.boot) == (5, "1", "b")
    assert (Life().began_us, Life().invocation, Life().boot) == (0, "", "")
    assert (life.first("x"), life.last("x"), life.last("y")) == (happenings[0], happenings[3], None)


def test_lives_by_invocation() -> None:
    """A request is of the session of who asked, and belongs to the life that it is about."""
    names = ("dataflow-starting", "stop-asked", "unit-stopping", "unit-starting", "x")
    lives = ("1", "session", "1", "2", "")
    happenings = [Happening(*one[:1], invocation=one[1]) for one in zip(names, lives, strict=True)]
    found = find_lives(happenings)
    assert [[one.name for one in life.happenings] for life in found] == [
        [*names[:3]],
        [*names[3:]],
    ]
    assert find_lives([]) == []


def test_lives_that_led_to_the_last_one() -> None:
    again = Life((Happening("unit-restart"),))
    last = Life((Happening("x"),))
    assert with_restarts([last, again, again, last]) == [again, again, last]
    assert with_restarts([again, last, last]) == [last]
    assert with_restarts([]) == []


IDS = {name: message for message, name in UNIT_MESSAGES.items()}


def test_a_record_of_ours() -> None:
    record = {
        **{"DORA_EVENT": "node-crashed", "DORA_NODE": "a", "DORA_EXIT": "exit code 1"},
        **{"MESSAGE": "x" * 5000, "_BOOT_ID": "b", "__REALTIME_TIMESTAMP": "7"},
        **{"_SYSTEMD_INVOCATION_ID": "1", "USER_INVOCATION_ID": "2", "EXIT_CODE": None},
    }
    one = parse_happening(record)
    assert one
    assert (one.name, one.at_us, one.node, one.invocation, one.boot) == (
        *("node-crashed", 7, "a", "1"),
        "b",
    )
    assert one.text == "x" * 4000, "a node may have written it"
    assert one.details == {
        **{"event": "node-crashed", "node": "a", "exit": "exit code 1", "exit_code": ""},
    }
    assert one.detail("exit") == "exit code 1"
    assert one.detail("owner") == ""


def test_the_name_of_a_node_cannot_be_a_command() -> None:
    """A node can write any record of its dataflow, and `why` names nodes in commands."""
    forged = {"DORA_EVENT": "node-crashed", "DORA_NODE": "$(id)"}
    assert (one := parse_happening(forged)) and not (one.node or one.detail("node"))
    end = {"DORA_EVENT": "dataflow-failed", "DORA_NODES": "a ;id b"}
    assert (one := parse_happening(end)) and one.detail("nodes") == "a b"
    silent = Facts("Degraded", silent={"a": "no line for 2s, starved of $(id)/image"})
    assert examine([Life()], silent).node == "a"


@pytest.mark.parametrize("key", ["INVOCATION_ID", "USER_INVOCATION_ID"])
def test_a_record_of_systemd(key: str) -> None:
    """Its own invocation is not that of the unit which it is about."""
    fields = {"EXIT_STATUS": "9", "N_RESTARTS": "2", "UNIT_RESULT": "signal", "COMMAND": "/x"}
    record = {"MESSAGE_ID": IDS["unit-failed"], key: "1", "_SYSTEMD_INVOCATION_ID": "0", **fields}
    one = parse_happening(record)
    assert one == Happening(
        "unit-failed", invocation="1", details={key.lower(): text for key, text in fields.items()}
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, ""),
        ("", ""),
        (7, "7"),
        ([], ""),
        ([97, 255], "a\N{REPLACEMENT CHARACTER}"),
        ([97, 256], "256"),
        ([0], "\0"),
        ([97, -1], "-1"),
        (["a", ["b", [99]]], "c"),
    ],
)
def test_the_text_of_a_field(value: object, text: str) -> None:
    assert plain_text(value) == text


@pytest.mark.parametrize(
    ("text", "number"), [("0", 0), ("12", 12), ("", None), ("-1", None), ("²", None), ("1x", None)]
)
def test_a_number_of_a_field(text: str, number: int | None) -> None:
    assert parse_number(text) == number


def test_how_a_stopped_node_ended() -> None:
    """What is unknown of a node is empty."""
    end = Happening("dataflow-failed", 9, details={"nodes": "a late"})
    life = Life((
        Happening("node-ready", 3, "a"),
        Happening("node-exited", 4, "a", details={"exit": "exit code 1"}),
        Happening("node-restarted", 5, "a"),
        Happening("node-restarted", 6, "a"),
        Happening("node-asked", 7, "b", details={"asked": "stop"}),
        end,
    ))  # fmt: skip
    rows = {row.node: row for row in ended_nodes(life)}
    assert list(rows) == ["a", "b", "late"]
    a, b, late = rows.values()
    assert (a.state, a.restarts, a.exit, a.since) == ("failed", 2, "exit code 1", 6)
    assert (b.state, b.restarts, b.since) == ("stopped", 0, 7)
    assert (late.state, late.restarts, late.exit) == ("failed", 0, "")


BY_HAND = "run: doractl restart {name}"
AUTOMATIC = f"{BY_HAND}; --restart-policy on-failure does this automatically"
SIZE = "; doractl advise {name} proposes sizes by what was held before"
MORE_MEMORY = f"doractl set {{name}} --memory-limit SIZE, or limit single nodes (--node){SIZE}"


@pytest.mark.parametrize(
    ("verdict", "remedy"),
    [
        (Verdict("Failed", Cause.DAEMON_LOST, policy="no"), AUTOMATIC),
        (Verdict("Failed", Cause.DAEMON_LOST, policy=""), AUTOMATIC),
        (Verdict("Failed", Cause.DAEMON_LOST, policy="on-failure"), BY_HAND),
        (Verdict("Failed", Cause.STOPPED_ON_MACHINE, policy="no"), BY_HAND),
        (Verdict("Failed", Cause.OUT_OF_MEMORY), MORE_MEMORY),
        (Verdict("Failed", Cause.NODE_OUT_OF_MEMORY, details={"owner": "dataflow"}), MORE_MEMORY),
        (
            Verdict("Failed", Cause.NODE_OUT_OF_MEMORY, details={"owner": "machine"}),
            "the machine is short of memory: limit single nodes "
            f"(--node NODE:memory_limit=SIZE){SIZE}",
        ),
        (
            Verdict("Failed", Cause.NODE_OUT_OF_MEMORY, details={"owner": "node"}),
            "find the leak in {node}, or run: "
            f"doractl set {{name}} --node {{node}}:memory_limit=SIZE{SIZE}",
        ),
        (
            Verdict("Failed", Cause.NODE_FAILED, details={"exit": "signal SIGKILL"}),
            "find out who killed {node}: journalctl -k, or a kill -9 by hand",
        ),
        (
            Verdict("Failed", Cause.NODE_FAILED, details={"exit": "signal SIGUSR1"}),
            "fix {node}, then run: doractl restart {name}",
        ),
        (
            Verdict("Failed", Cause.NODE_FAILED, details={"exit": "exit code 9"}),
            "fix {node}, then run: doractl restart {name}",
        ),
        (
            Verdict("Failed", Cause.NODE_HUNG, details={"exit": "signal SIGKILL"}),
            "find out what {node} waited for, or raise health_check_timeout: in its YAML",
        ),
        (
            Verdict("Failed", Cause.NODE_WATCHDOG, "node a: hung, no WATCHDOG=1 for 2s"),
            "find out what {node} waited for, or raise watchdog: in its settings",
        ),
        (
            Verdict("Failed", Cause.NODE_WATCHDOG, "node a: hung, not ready within 1min 30s"),
            "find out what {node} waited for, or raise --start-timeout",
        ),
        (
            Verdict("Failed", Cause.NODE_WATCHDOG, "node a: hung, it sent WATCHDOG=trigger"),
            "find out why {node} sent WATCHDOG=trigger",
        ),
        (
            Verdict("Waiting", Cause.MACHINE_LOST),
            "nothing: it starts when all machines are there; doractl stop {name} gives up",
        ),
        (Verdict("Waiting", Cause.NONE), ""),
        (Verdict("Failed", Cause.MACHINE_LOST), AUTOMATIC),
        (
            Verdict("Frozen", Cause.NODE_FAILED),
            "somebody has frozen the unit; run: systemctl {flag} thaw {unit}",
        ),
    ],
)
def test_the_remedy(verdict: Verdict, remedy: str) -> None:
    assert remedy_of(verdict) == remedy


@pytest.mark.parametrize(
    ("verdict", "is_failure", "is_away"),
    [
        (Verdict("Failed"), True, False),
        (Verdict("Restarting", node="a"), True, False),
        (Verdict("Stopped", node="a"), False, False),
        (Verdict("Degraded", node="a"), True, True),
        (Verdict("Degraded"), False, False),
        (Verdict("Running", node="a", is_passing=True), False, False),
        (Verdict("Running", Cause.NODE_SILENT, node="a"), True, False),
        (Verdict("Degraded", Cause.NODE_SILENT, node="a", details={"exit": "x"}), True, True),
    ],
)
def test_what_is_a_failure(verdict: Verdict, is_failure: bool, is_away: bool) -> None:
    assert (verdict.is_failure, verdict.is_away) == (is_failure, is_away)


def test_what_an_ended_dataflow_has_to_say_of_itself() -> None:
    """STATUS= of a unit stays after its end, and is about what was."""
    assert judge(*RUNS, *STOPPED, facts=Facts("Stopped", "stopped")).now == ""
    assert judge(*RUNS, facts=Facts("Running", "2/2 nodes running")).now == "2/2 nodes running"


def test_when_memory_ended_it() -> None:
    exited = unit("process-exited", EXIT_CODE="killed", EXIT_STATUS="9")
    end = unit("unit-failed", UNIT_RESULT="signal")
    verdict = judge(*RUNS, unit("unit-oom"), exited, end)
    assert (verdict.cause, verdict.at_us) == (Cause.OUT_OF_MEMORY, 5)
    assert verdict.details["unit_result"] == "signal"

"""The report of `doractl why`, line by line, as text and as JSON."""

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.refusal import NOT_EXECUTED
from dora_systemd.decisions.logs.journal_events import ROLLED_BACK as BACK_EVENT
from dora_systemd.decisions.releases.past import FAILED, ROLLED_BACK, Switch
from dora_systemd.decisions.resources.rivals import Rival
from dora_systemd.decisions.views.rows import Bundles, DataflowRow, Holder
from dora_systemd.decisions.why.last_lines import Word
from dora_systemd.decisions.why.lives import Happening
from dora_systemd.decisions.why.report import (
    Report,
    Subject,
    format_report,
    remedies,
    report_object,
)
from dora_systemd.decisions.why.stack import NATIVE, PYTHON, Frame
from dora_systemd.decisions.why.verdict import Restart, Verdict
from dora_systemd.decisions.why.waits import CpuWait
from dora_systemd.names import STORE, TREE
from dora_systemd.values import SECOND

UUID = "550e8400-e29b-41d4-a716-446655440000"
SUBJECT = Subject(UUID, "robot", "dora-robot.service", "--system", "/srv/robot.yml", True)
BEGAN = 1_768_482_000 * SECOND  # 2026-01-15 13:00:00 UTC
CRASHED = BEGAN + 5 * SECOND
VERDICT = Verdict(
    "Failed",
    Cause.NODE_OUT_OF_MEMORY,
    "node camera: out of memory",
    node="camera",
    at_us=CRASHED,
    began_us=BEGAN,
    details={
        **{"event": "node-oom", "node": "camera", "downstream": "detector plot"},
        **{"owner": "node", "peak": "314572800", "limit": "209715200", "held": "1048576"},
        **{"node_pid": "7", "exit": "out of memory"},
    },
    starved=("detector", "plot"),
    restarts=(
        Restart(BEGAN + 1, "dora", "camera", "exit code 1"),
        Restart(BEGAN + 2, "systemd", "", "gone"),
        Restart(BEGAN + 3, "dora", "camera", "exit code 1"),
    ),
    timeline=(
        Happening("dataflow-started", BEGAN, text="Dataflow robot started"),
        Happening("node-oom", CRASHED, "camera"),
    ),
    before="stopped by root",
    before_us=BEGAN - SECOND,
)
WORDS = (Word(CRASHED - 1, "camera", "loading"), Word(CRASHED, "camera", "slow", 3))
FULL = Report(
    SUBJECT,
    VERDICT,
    WORDS,
    budget={"used": 1, "max": 5, "next_us": None, "resets_us": 60 * SECOND},
    inhibitors=(Holder(231, "dora", "python arm.py", "arm", "it moves"),),
    machines={"gpu": "alice@gpu-box", "cam": ""},
)


@pytest.fixture(autouse=True)
def utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


def test_all_that_can_be_told() -> None:
    assert (
        format_report(FULL)
        == f"""\
robot: Failed
  Why:      node camera: out of memory
  When:     2026-01-15 13:00:05 UTC, 5s after its start
  Machines: head, gpu (alice@gpu-box), cam
  Memory:   peak 300M, limit 200M, held 1M
  Starved:  detector, plot
  Restarts: camera 2 (exit code 1), dataflow 1 (gone)
  Budget:   1/5 restarts of the dataflow used, resets in 1min
  Inhibit:  node arm (PID 231, user dora, python arm.py): it moves
  Before:   stopped by root (2026-01-15 12:59:59 UTC)
  Unit:     dora-robot.service ({UUID})
  File:     /srv/robot.yml

What happened:
  01-15 13:00:00  Dataflow robot started
  01-15 13:00:05  node-oom

The last 2 lines of camera (all: doractl logs robot --node camera):
  13:00:04  loading
  13:00:05  slow
  13:00:05  ... the same line, 3 times in all

What to do:
  find the leak in camera, or run: doractl set robot --node camera:memory_limit=SIZE; \
doractl advise robot proposes sizes by what was held before"""
    )


def test_what_is_not_known_is_left_out() -> None:
    """Nothing but the unit."""
    assert format_report(Report(replace(SUBJECT, file=""), Verdict("Stopped"))) == (
        f"robot: Stopped\n  Unit:     dora-robot.service ({UUID})"
    )


def test_headings_are_bold_on_a_terminal() -> None:
    lines = format_report(FULL, 80, want_colors=True).split("\n")
    bold = [line for line in lines if line.startswith("\x1b[1m") and line.endswith("\x1b[0m")]
    assert bold[1:] == [
        "\x1b[1mWhat happened:\x1b[0m",
        "\x1b[1mThe last 2 lines of camera (all: doractl logs robot --node camera):\x1b[0m",
        "\x1b[1mWhat to do:\x1b[0m",
    ]


@pytest.mark.parametrize(
    ("width", "name", "title"),
    [(None, "r" * 90, "r" * 90), (20, "robot", "robot"), (20, "r" * 90, "r" * 12)],
)
def test_the_status_is_whole_at_any_width(width: int | None, name: str, title: str) -> None:
    text = format_report(Report(replace(SUBJECT, name=name), Verdict("Failed")), width)
    first = text.split("\n")[0]
    assert first.endswith(": Failed")
    assert first.removesuffix(": Failed")[:11] == title[:11]
    assert len(first) == len(title) + len(": Failed")


@pytest.mark.parametrize("want_colors", [False, True])
def test_the_command_for_all_lines_is_whole_at_any_width(want_colors: bool) -> None:
    lines = format_report(FULL, 50, want_colors).replace("\x1b[1m", "").replace("\x1b[0m", "")
    heading = "The last 2 lines of camera (all: doractl logs\n  robot --node camera):\n"
    assert heading in lines


def facts(verdict: Verdict, **more: Any) -> dict[str, str]:
    """The lines below the title, by their first word."""
    report = replace(FULL, verdict=verdict, **more)
    block = format_report(report).split("\n\n")[0].split("\n")[1:]
    return {line.split(":")[0].strip(): line[12:] for line in block}


@pytest.mark.parametrize(
    ("began_us", "at_us", "words"),
    [
        (0, 0, None),
        (BEGAN, 0, "started 2026-01-15 13:00:00 UTC"),
        (0, CRASHED, "2026-01-15 13:00:05 UTC"),
        (BEGAN, BEGAN, "2026-01-15 13:00:00 UTC"),
        (BEGAN, BEGAN + 999, "2026-01-15 13:00:00 UTC"),
        (BEGAN, BEGAN + 1000, "2026-01-15 13:00:00 UTC, 1ms after its start"),
        (CRASHED, BEGAN, "2026-01-15 13:00:00 UTC"),
        (BEGAN, BEGAN + 1_500, "2026-01-15 13:00:00 UTC, 1ms after its start"),
        (BEGAN, BEGAN + SECOND - 1, "2026-01-15 13:00:00 UTC, 999ms after its start"),
        (BEGAN, BEGAN + SECOND, "2026-01-15 13:00:01 UTC, 1s after its start"),
        (BEGAN, BEGAN + 61_900_000, "2026-01-15 13:01:01 UTC, 1min 1s after its start"),
    ],
)
def test_when_it_was(began_us: int, at_us: int, words: str | None) -> None:
    """A clock that was set back makes no duration."""
    found = facts(replace(VERDICT, began_us=began_us, at_us=at_us))
    assert found.get("When") == words


def test_when_it_was_ready() -> None:
    found = facts(replace(VERDICT, began_us=BEGAN, ready_us=CRASHED, at_us=0))
    assert found["When"] == "started 2026-01-15 13:00:00 UTC, ready 2026-01-15 13:00:05 UTC"


@pytest.mark.parametrize(
    ("details", "words"),
    [
        ({}, None),
        ({"owner": "machine"}, None),
        ({"peak": "0"}, None),
        ({"peak": "1048576x"}, None),
        ({"held": "1048576", "owner": "machine"}, "held 1M; the machine had no memory left"),
        ({"limit": "1048576", "owner": "dataflow"}, "limit 1M of the dataflow"),
        ({"limit": "1048576", "owner": "else"}, "limit 1M"),
    ],
)
def test_whose_memory_it_was(details: dict[str, str], words: str | None) -> None:
    assert facts(replace(VERDICT, details=details)).get("Memory") == words


@pytest.mark.parametrize(
    ("status", "used", "is_told"),
    [("Failed", 0, False), ("Failed", 1, True), ("Restarting", 0, True)],
)
def test_the_budget_is_told_while_a_restart_may_come(status: str, used: int, is_told: bool) -> None:
    budget = {"used": used, "max": 5, "next_us": None, "resets_us": None}
    found = facts(replace(VERDICT, status=status), budget=budget)
    assert found.get("Budget") == (f"{used}/5 restarts of the dataflow used" if is_told else None)
    assert "Budget" not in facts(replace(VERDICT, status=status), budget=None)


def test_one_machine_has_no_list_of_machines() -> None:
    assert "Machines" not in facts(VERDICT, machines={})


def test_nodes_that_somebody_has_stopped() -> None:
    found = facts(replace(VERDICT, stopped={"plot": "root (doractl node stop)"}, now="1/2"))
    assert found["Stopped"] == "plot, requested by root (doractl node stop)"
    assert found["Now"] == "1/2"


OLD, NEW = "20260115T130000-0badcafe", "20260116T130000-0badcafe"
BUILD = Happening("build-failed", BEGAN, details={"release": OLD, "reason": "uv failed"})
BACK = Happening(BACK_EVENT, CRASHED, details={"release": NEW, "reason": "node a: x"})


@pytest.mark.parametrize(
    ("timeline", "undone", "words"),
    [
        ((), None, None),
        ((BUILD,), None, f"{OLD} at 2026-01-15 13:00:00 UTC: uv failed"),
        ((BUILD, BACK), None, f"{NEW} at 2026-01-15 13:00:05 UTC: node a: x"),
        (
            (BUILD,),
            Switch(CRASHED, "mine", OLD, ROLLED_BACK, "root"),
            "mine at 2026-01-15 13:00:05 UTC: rolled back by root",
        ),
        (
            (),
            Switch(CRASHED, "mine", OLD, ROLLED_BACK),
            "mine at 2026-01-15 13:00:05 UTC: rolled back by -",
        ),
        (
            (BACK,),
            Switch(BEGAN, "mine", OLD, FAILED, reason="node b: y"),
            "mine at 2026-01-15 13:00:00 UTC: node b: y",
        ),
        (
            (replace(BUILD, at_us=CRASHED),),
            Switch(BEGAN, "mine", OLD, FAILED, reason="node b: y"),
            f"{OLD} at 2026-01-15 13:00:05 UTC: uv failed",
        ),
    ],
)
def test_the_last_release_that_was_undone(
    timeline: tuple[Happening, ...], undone: Switch | None, words: str | None
) -> None:
    """The history says more about a way back than the event."""
    found = facts(replace(VERDICT, timeline=timeline), undone=undone)
    assert found.get("Undone") == words


@pytest.mark.parametrize(
    ("bundles", "words"),
    [
        (None, None),
        (Bundles(1, "/x.tar", BEGAN - SECOND // 2), "/x.tar"),
        (Bundles(1, "/x.tar", BEGAN - 2 * SECOND), None),
        (Bundles(3, "/x.tar", CRASHED), "/x.tar and 2 more"),
        (Bundles(0, "", 0, 1, CRASHED, "it is full"), "1 not written, the last: it is full"),
        (
            Bundles(1, "/x.tar", 5, 2, CRASHED, "too soon"),
            "/x.tar; 2 not written, the last: too soon",
        ),
    ],
)
def test_the_bundle_that_a_failure_has_left(bundles: Bundles | None, words: str | None) -> None:
    verdict = replace(VERDICT, before="", before_us=0)
    assert facts(verdict, bundles=bundles).get("Bundle") == words


def news(count: int) -> list[str]:
    happenings = tuple(Happening(f"n{n}", BEGAN + n * SECOND) for n in range(count))
    report = Report(SUBJECT, replace(VERDICT, timeline=happenings))
    return [line.split("  ")[-1] for line in format_report(report).split("\n\n")[1].split("\n")[1:]]


def test_the_first_and_the_last_things_that_happened() -> None:
    assert news(7) == [f"n{n}" for n in range(7)]
    assert news(8) == ["n0", "n1", "... 1 more ...", "n3", "n4", "n5", "n6", "n7"]
    assert news(30)[:3] == ["n0", "n1", "... 23 more ..."]
    assert news(30)[3:] == ["n25", "n26", "n27", "n28", "n29"]


def test_a_moment_that_is_not_known() -> None:
    report = Report(SUBJECT, replace(VERDICT, timeline=(Happening("n"),)))
    assert "What happened:\n  -  n\n" in format_report(report)


@pytest.mark.parametrize(
    ("words", "node", "trial", "title"),
    [
        (WORDS[:1], "camera", False, "The last line of camera (all: doractl logs robot --node "),
        (WORDS, "", False, "The last 2 lines of its nodes (all: doractl logs robot):"),
        (WORDS, "", True, "The last 2 lines of b in mine (all: doractl logs robot --node b):"),
    ],
)
def test_whose_lines_they_are(words: tuple[Word, ...], node: str, trial: bool, title: str) -> None:
    undone = Switch(CRASHED, "mine", OLD, FAILED, reason="node b: y", node="b")
    verdict = replace(VERDICT, node=node)
    report = Report(SUBJECT, verdict, words, undone=undone, is_of_trial=trial)
    block = format_report(report).split("\n\n")[2].split("\n")
    assert block[0].startswith(title)
    assert block[1] == ("  13:00:04  loading" if node or trial else "  13:00:04  camera: loading")


def test_lines_do_not_control_the_terminal() -> None:
    word = Word(CRASHED, "camera", "a\x1b[2Jb\nWhat to do:")
    lines = format_report(replace(FULL, words=(word,))).split("\n")
    assert "\x1b" not in "".join(lines)
    assert lines.count("What to do:") == 1


PASSING = replace(VERDICT, status="Running", is_passing=True)
DEGRADED = replace(VERDICT, cause=Cause.NODE_FAILED, status="Degraded", details={})
OF_MACHINE = replace(
    VERDICT, cause=Cause.MACHINE_LOST, node="", details={"machine": "gpu", "reason": "x"}
)
AWAY = "camera stays down until doractl restart robot; the other nodes keep running"


@pytest.mark.parametrize(
    ("verdict", "lines"),
    [
        (
            replace(PASSING, restarts=()),
            ["nothing: dora restarts camera automatically"],
        ),
        (
            replace(PASSING, cause=Cause.NODE_HUNG, details={}),
            [
                "find out what camera waited for, or raise health_check_timeout: in its YAML",
                "dora restarts camera automatically, and so finds it fixed",
            ],
        ),
        (DEGRADED, ["fix camera, then run: doractl restart robot", AWAY]),
        (
            replace(OF_MACHINE, policy="always"),
            [
                "run: doractl restart robot",
                "doractl -H alice@gpu-box why robot shows what machine gpu has seen",
            ],
        ),
        (
            replace(OF_MACHINE, details={"machine": "cam"}, policy="no"),
            [
                "run: doractl restart robot; --restart-policy on-failure does this automatically",
            ],
        ),
        (
            replace(VERDICT, cause=Cause.UNIT_FAILED, is_given_up=True, status="Restarting"),
            [
                "systemctl --system status dora-robot.service shows what systemd did",
                "systemd has stopped restarting it; doractl restart robot resets the counter",
            ],
        ),
        (
            replace(VERDICT, cause=Cause.UNIT_FAILED, summary=NOT_EXECUTED),
            [
                "systemctl --system status dora-robot.service names its program; if that is gone, "
                "doractl start robot says how to start it again",
            ],
        ),
        (
            replace(VERDICT, cause=Cause.NO_ANSWER, status="Restarting"),
            [
                "run: doractl restart robot; check whether the machine was overloaded",
                "systemd restarts it automatically; doractl stop robot prevents that",
            ],
        ),
        (
            replace(
                VERDICT, cause=Cause.NODE_FAILED, details={"exit": "signal SIGSEGV"}
            ),
            ["fix camera; coredumpctl info PID shows where it crashed"],
        ),
        (replace(VERDICT, cause=Cause.START_TIMEOUT, node=""), [
            "find out why the node does not call Node(), or raise --start-timeout",
        ]),
        (replace(VERDICT, cause=Cause.FINISHED, status="Finished"), []),
    ],
)  # fmt: skip
def test_what_to_do(verdict: Verdict, lines: list[str]) -> None:
    assert remedies(replace(FULL, verdict=verdict)) == lines


FRAMES = (
    Frame(NATIVE, "grab\x1b[2J", "libgrab.so + 0x1119"),
    Frame(PYTHON, "read", "/home/camera.py:12"),
)


def test_where_it_crashed() -> None:
    """Before what happened: that is what somebody searches."""
    text = format_report(replace(FULL, stack=FRAMES))
    frames = (
        "\nWhere it crashed:\n  grab\\x1b[2J (libgrab.so + 0x1119)\n  read (/home/camera.py:12)\n"
    )
    assert frames in text
    assert text.index(frames) < text.index("What happened:")
    assert "Where it crashed" not in format_report(FULL)
    found = report_object(replace(FULL, stack=FRAMES), ROW)["stack"]
    assert found[1] == {"language": "python", "function": "read", "place": "/home/camera.py:12"}


def test_who_had_the_cpu() -> None:
    rival = Rival(77, "st\x1b[2Jress", 97.2)
    report = replace(FULL, waits=(CpuWait("camera", 31.2, cpus="2-3", rivals=(rival,)),))
    text = format_report(report)
    assert "  CPU:      camera waited 31% of the last minute for a CPU: cpus 2-3 also have" in text
    assert "process 77 (st\\x1b[2Jress, 97%)" in text
    assert remedies(report)[-1].startswith("keep other processes away from cpus 2-3: ")
    (found,) = report_object(report, ROW)["cpu_waits"]
    assert (found["node"], found["waited_percent"]) == ("camera", 31.2)


@pytest.mark.parametrize(
    ("has_dump", "stack", "remedy"),
    [
        (True, FRAMES, "fix camera; coredumpctl info PID shows where it crashed"),
        (False, FRAMES, "fix camera"),
        (False, (), "fix camera; doractl doctor says why there is no core dump that shows where it "
         "crashed"),
    ],
)  # fmt: skip
def test_what_to_do_about_a_crash(has_dump: bool, stack: tuple[Frame, ...], remedy: str) -> None:
    verdict = replace(VERDICT, cause=Cause.NODE_FAILED, details={"exit": "signal SIGSEGV"})
    report = replace(FULL, verdict=verdict, stack=stack, keeps_core_dumps=has_dump)
    assert remedies(report) == [remedy]


def test_what_to_do_about_a_release() -> None:
    """Its files are read-only, so a fix is another release."""
    again = ["fix camera, then run: doractl deploy --name robot"]
    failed = replace(VERDICT, cause=Cause.NODE_FAILED, details={})
    assert remedies(replace(FULL, verdict=replace(failed, timeline=(BACK,)))) == again
    assert remedies(replace(FULL, verdict=failed)) != again
    file = f"/{STORE}/robot/{OLD}/{TREE}/robot.yml"
    released = replace(FULL, subject=replace(SUBJECT, file=file), verdict=failed)
    assert f"\n  Release:  {OLD}\n" in format_report(released)
    assert remedies(released) == again
    bad = replace(VERDICT, cause=Cause.BAD_DATAFLOW, details={})
    fix = "fix robot.yml in its project, then run: doractl deploy --name robot"
    assert remedies(replace(released, verdict=bad)) == [fix]
    (unknown,) = remedies(replace(released, verdict=replace(bad, cause=Cause.NO_END)))
    assert unknown.startswith("run: doractl start robot; ")


def test_what_to_do_about_a_trial() -> None:
    undone = Switch(CRASHED, "mine", OLD, FAILED, node="b")
    failed = replace(FULL, verdict=Verdict("Running"), undone=undone, is_of_trial=True)
    assert remedies(failed) == ["fix b, then run: doractl deploy --name robot"]
    assert remedies(replace(failed, undone=undone._replace(node=""))) == []
    full = replace(failed, words=(Word(CRASHED, "b", "No module named 'dora'"),))
    assert remedies(full)[0].startswith("its Python has no dora-rs: ")
    assert remedies(replace(full, undone=undone._replace(node=""))) == []


def test_what_to_do_about_one_that_is_gone() -> None:
    gone = replace(SUBJECT, is_loaded=False)
    failed = replace(FULL, subject=gone, verdict=replace(DEGRADED, status="Failed"))
    again = "doractl start /srv/robot.yml --name robot"
    assert remedies(failed) == [f"fix camera, then run: {again}"]
    unknown = replace(failed, subject=replace(gone, file=""))
    assert remedies(unknown) == ["fix camera, then run: doractl start FILE --name robot"]


@pytest.mark.parametrize("cause", [Cause.BAD_DATAFLOW, Cause.NO_END, Cause.OTHER_VERSION])
@pytest.mark.parametrize("is_loaded", [True, False])
def test_a_path_that_is_a_command_is_quoted(cause: Cause, is_loaded: bool) -> None:
    subject = replace(SUBJECT, file="/home/a/x; id/robot.yml", is_loaded=is_loaded)
    verdict = replace(VERDICT, cause=cause, details={})
    (text,) = remedies(replace(FULL, subject=subject, verdict=verdict))
    assert "'/home/a/x; id/robot.yml'" in text
    assert text.count("x; id") == text.count("'/home/a/x; id/robot.yml'")


def test_a_process_that_is_no_number_is_not_named() -> None:
    details = {"exit": "signal SIGSEGV", "node_pid": "7; id"}
    verdict = replace(VERDICT, cause=Cause.NODE_FAILED, details=details)
    assert remedies(replace(FULL, verdict=verdict)) == [
        "fix camera; coredumpctl info PID shows where it crashed"
    ]


def test_what_waits_for_its_file() -> None:
    held = replace(FULL, verdict=DEGRADED, is_held=True)
    assert remedies(held) == [
        "fix camera, and save it",
        "camera stays down until its file is saved, which hot reload sees, or until "
        "doractl reload robot --node camera; the other nodes keep running",
    ]
    ended = replace(held, verdict=replace(DEGRADED, status="Failed"))
    assert remedies(ended) == ["fix camera, then run: doractl restart robot"]


ROW = DataflowRow(UUID, "robot", "dora-robot.service", "Restarting", "/etc/robot.yml")


def test_the_same_for_programs() -> None:
    undone = Switch(CRASHED, "mine", OLD, FAILED, "root", "node b: y", "b", "id")
    found = report_object(replace(FULL, undone=undone), ROW._replace(ready=BEGAN + SECOND))
    began, at = found["started"], found["at"]
    assert began.startswith("2026-01-15T13:00:00")
    assert at.startswith("2026-01-15T13:00:05")
    wanted = {
        "status": "Failed",
        "file": "/etc/robot.yml",
        "is_failure": True,
        "cause": "node-out-of-memory",
        "summary": "node camera: out of memory",
        "now": None,
        "node": "camera",
        "at_us": CRASHED,
        "started_us": BEGAN,
        "ready_us": BEGAN + SECOND,
        "stopped_by": None,
        "given_up": False,
        "details": {
            "owner": "node",
            "exit": "out of memory",
            "memory_peak_bytes": 314572800,
            "memory_limit_bytes": 209715200,
            "memory_bytes": 1048576,
            "pid": 7,
        },
        "starved": ["detector", "plot"],
        "remedies": remedies(replace(FULL, undone=undone)),
    }
    assert {key: found[key] for key in wanted} == wanted
    assert found["undone"] == {
        **{"name": "robot", "at": at, "at_us": CRASHED, "from": "mine", "to": OLD},
        **{"ended": FAILED, "by": "root", "reason": "node b: y", "node": "b"},
    }
    assert found["before"].pop("at").startswith("2026-01-15T12:59:59")
    assert found["before"] == {"at_us": BEGAN - SECOND, "summary": "stopped by root"}
    assert [one.pop("at")[:19] for one in found["restart_history"]] == ["2026-01-15T13:00:00"] * 3
    assert found["restart_history"][:2] == [
        {"at_us": BEGAN + 1, "owner": "dora", "node": "camera", "reason": "exit code 1"},
        {"at_us": BEGAN + 2, "owner": "systemd", "node": None, "reason": "gone"},
    ]
    assert found["timeline"] == [
        {
            **{"at": began, "at_us": BEGAN, "event": "dataflow-started", "node": None},
            "text": "Dataflow robot started",
        },
        {"at": at, "at_us": CRASHED, "event": "node-oom", "node": "camera", "text": None},
    ]
    assert [one.pop("at")[:19] for one in found["last_lines"]] == [
        "2026-01-15T13:00:04",
        "2026-01-15T13:00:05",
    ]
    assert found["last_lines"] == [
        {"at_us": CRASHED - 1, "node": "camera", "text": "loading", "times": 1},
        {"at_us": CRASHED, "node": "camera", "text": "slow", "times": 3},
    ]


def test_what_is_not_known_is_null() -> None:
    found = report_object(
        Report(SUBJECT, Verdict("Stopped", stopped_by="root", now="x")), ROW._replace(dataflow="")
    )
    keys = ("cause", "summary", "node", "at", "at_us", "started_us", "ready_us", "before", "undone")
    assert {found[key] for key in keys} == {None}
    assert (found["stopped_by"], found["now"], found["details"]) == ("root", "x", {})
    assert found["file"] == "/srv/robot.yml", "the journal knows it when systemd does not"
    assert found["restart_history"] == found["timeline"] == found["last_lines"] == []


def test_a_number_that_is_none_is_null() -> None:
    verdict = replace(VERDICT, details={"exit_status": "KILL", "n_restarts": "3", "peak": "²"})
    assert report_object(Report(SUBJECT, verdict), ROW)["details"] == {
        "exit_status": None,
        "n_restarts": 3,
        "memory_peak_bytes": None,
    }


def test_the_heading_of_the_last_lines_fits() -> None:
    lines = format_report(replace(FULL, inhibitors=(), machines={}), 40).split("\n")
    heading = next(line for line in lines if line.startswith("The last 2 lines"))
    assert len(heading) <= 40

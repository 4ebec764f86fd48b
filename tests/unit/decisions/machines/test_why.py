"""What `why` says of a dataflow on several machines."""

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.why.lives import Happening, Life
from dora_systemd.decisions.why.postmortem import examine, stopped_by
from dora_systemd.decisions.why.report import Report, Subject, format_report
from dora_systemd.decisions.why.verdict import Facts, Verdict

WAITS = "waiting for machine gpu (ssh: Connection timed out)"
LOST = Happening(
    "machine-lost",
    3_000_000,
    text="Machine gpu of dataflow robot is lost",
    details={"machine": "gpu", "reason": "no word for 8 s"},
)
FAILED = Happening(
    "dataflow-failed",
    4_000_000,
    details={"cause": "machine-lost", "reason": "machine gpu: no word for 8 s"},
)
FIRST = Life(
    (
        Happening("dataflow-starting", 1_000_000),
        LOST,
        FAILED,
        Happening("unit-restart", 5_000_000),
    )
)
SECOND = Life((Happening("dataflow-starting", 6_000_000),))


def report_of(verdict: Verdict) -> str:
    subject = Subject("u", "robot", "dora-robot.service", "--system", "/srv/a.yml", True)
    machines = {"gpu": "alice@gpu-box", "npu": ""}
    return format_report(Report(subject, verdict, machines=machines))


def test_it_waits_for_a_machine_that_it_had() -> None:
    found = examine([FIRST, SECOND], Facts("Waiting", WAITS, is_gathering=True))
    assert found.cause is Cause.MACHINE_LOST
    text = report_of(found)
    assert "  Why:      machine gpu: no word for 8 s\n" in text
    assert f"  Now:      {WAITS}\n" in text
    assert "  Machines: head, gpu (alice@gpu-box), npu\n" in text
    assert "nothing: it starts when all machines are there; doractl stop robot gives up" in text
    assert "doractl -H alice@gpu-box why robot shows what machine gpu has seen" in text


def test_it_waits_for_a_machine_that_never_came() -> None:
    found = examine([SECOND], Facts("Waiting", WAITS, is_gathering=True))
    assert found.cause is Cause.NONE
    assert f"  Now:      {WAITS}\n" in report_of(found)


def test_a_lost_machine_ended_it() -> None:
    found = examine([Life(FIRST.happenings[:-1])], Facts("Failed", "machine gpu: no word for 8 s"))
    assert (found.cause, found.at_us) == (Cause.MACHINE_LOST, LOST.at_us)
    text = report_of(found)
    assert "doractl restart robot; --restart-policy on-failure does this" in text
    assert "doractl -H alice@gpu-box why robot" in text


def test_a_policy_that_is_set_is_no_advice() -> None:
    life = Life(FIRST.happenings[:-1])
    found = examine([life], Facts("Failed", "", policy="on-failure"))
    text = report_of(found)
    assert "run: doractl restart robot\n" in text
    assert "--restart-policy" not in text


def test_a_part_that_its_head_ends() -> None:
    stopping = Happening("dataflow-stopping", 4_000_000, details={"by": "head"})
    told = (Happening("dataflow-starting", 1_000_000), stopping)
    assert stopped_by(Life(told), ()) == "its head"
    lost = Happening("machine-lost", 3_000_000, details={"machine": "head", "reason": "no word"})
    assert stopped_by(Life((told[0], lost, stopping)), ()) == "the loss of its head (no word)"

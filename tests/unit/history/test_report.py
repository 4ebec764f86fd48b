"""The figures of several histories."""

from tests.history.checker import Complaint
from tests.history.history import Answer, History, Line, Look, Vital
from tests.history.report import Report
from tests.history.steps import NO_TARGET, Step


def history() -> History:
    """A fault that hit, one that did not, and a gateway that grew by 4 KiB."""
    looks = (Look(at, True, 2.0, {}, {"gateway": Vital(7, 1, 40 + at, 5)}) for at in (0, 1, 5))
    return History(
        answers=(Answer(0, Step("kill-runner"), 0), Answer(1, Step("kill-daemon"), NO_TARGET)),
        looks=tuple(looks),
        lines=(Line("a", "sink.1", 1),),
    )


def test_a_report_adds_up() -> None:
    report = Report()
    for seed in (1, 2):
        report.add(seed, history(), [Complaint("flat", "it is not")])
    text = report.format()
    assert "steps 2, looks 6, lines checked 2" in text
    assert "kill-runner              2" in text
    assert "kill-daemon              2 without a target" in text
    assert "gateway: most growth 4 KiB, 0 descriptors" in text
    assert "gateway (pid 7, 1) over all: 41 to 45 KiB, 5 to 5 descriptors" in text
    assert "complaints {'flat': 2}" in text


def test_a_seed_has_a_line_and_its_complaints() -> None:
    line = Report().line_of(3, history(), [Complaint("flat", "it is not")])
    head = "seed 3: 2 steps, 3 looks, 1 lines, pace 2.0, 1 complaints"
    assert line.splitlines() == [head, "  flat: it is not"]

"""What fails the trial of a release."""

import pytest

from dora_systemd.decisions.why.lives import Happening
from dora_systemd.decisions.why.trial_faults import Fault, find_fault, is_finished

CRASH = Happening("node-crashed", 20, "a", "Node a crashed", "new", details={"exit": "exit code 1"})


def test_the_first_fault_counts() -> None:
    later = Happening("dataflow-failed", 30, "", "failed", "new", details={"reason": "node a: x"})
    ready = Happening("node-ready", 10, "a", "", "new")
    assert find_fault([later, CRASH, ready], "old") == Fault("node a: exit code 1", "a")
    assert find_fault([later, ready], "old") == Fault("node a: x")
    assert find_fault([ready], "old") is None


def test_the_end_of_the_one_before_is_none() -> None:
    assert find_fault([CRASH], "new") is None


def test_a_hang_has_words() -> None:
    hung = Happening("node-hung", 20, "a", "Node a hangs", "new")
    assert find_fault([hung], "") == Fault("node a: hung", "a")
    for event, reason, words in (
        ("node-watchdog", "no WATCHDOG=1 for 2s", "hung, no WATCHDOG=1 for 2s"),
        ("node-waiting", "/dev/video0 (not there)", "waits for /dev/video0 (not there)"),
        ("node-silent", "no image for 2s", "silent, no image for 2s"),
    ):
        one = Happening(event, 20, "a", "", "new", details={"reason": reason})
        assert find_fault([one], "") == Fault(f"node a: {words}", "a")


def test_a_leak_has_its_limit() -> None:
    """As the runner reports it, see test_a_node_over_its_limit_is_killed_alone on a real kernel."""
    exit_text = "out of memory, peak 200M, limit 200M"
    leak = Happening("node-oom", 20, "a", "", "new", details={"exit": exit_text})
    assert find_fault([leak], "") == Fault(f"node a: {exit_text}", "a")


def test_a_dataflow_may_finish() -> None:
    finished, stopped = Happening("dataflow-finished", 20), Happening("dataflow-stopped", 30)
    assert is_finished([finished])
    assert not is_finished([stopped, finished])
    assert not is_finished([])


@pytest.mark.parametrize(
    ("details", "text", "fault"),
    [
        ({"reason": "node a: x", "nodes": "a b"}, "failed", Fault("node a: x", "a")),
        ({"reason": "gone"}, "failed", Fault("gone")),
        ({"nodes": "a"}, "Dataflow robot failed", Fault("Dataflow robot failed", "a")),
        ({}, "", Fault("dataflow-failed")),
    ],
)
def test_the_failure_of_all_names_the_first_node(
    details: dict[str, str], text: str, fault: Fault
) -> None:
    one = Happening("dataflow-failed", 20, "", text, "new", details=details)
    assert find_fault([one], "") == fault

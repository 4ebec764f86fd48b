"""Nodes that waited for a CPU, in words, and what to do."""

import pytest

from dora_systemd.decisions.resources.rivals import Rival, Shared
from dora_systemd.decisions.why.waits import CpuWait, format_cpu_waits, wait_remedies
from dora_systemd.values import SECOND

SHARED = Shared("camera", "/dev/video0", "2-3", ("xhci_hcd",), (142,), "0-1")
STRESS = Rival(77, "stress", 97.2)
CAMERA = CpuWait("camera", 31.2, cpus="2-3", rivals=(STRESS,), shared=(SHARED,))


@pytest.mark.parametrize(
    ("wait", "words"),
    [
        (
            CAMERA,
            "camera waited 31% of the last minute for a CPU: cpus 2-3 also have "
            "process 77 (stress, 97%), the interrupts of xhci_hcd (/dev/video0)",
        ),
        (
            CpuWait("arm", 44.0, SECOND // 4, rivals=(STRESS,)),
            "arm waited 44% of 0.2 s for a CPU: the CPUs also have process 77 (stress, 97%)",
        ),
        (
            CpuWait("arm", 60.0, throttled=58.0),
            "arm waited 60% of the last minute for a CPU, it had to wait for its limit 58% of the "
            "time",
        ),
        (
            CpuWait("", throttled=58.0),
            "the dataflow had to wait for its limit 58% of the time",
        ),
        (CpuWait("arm", 3.0, throttled=90.0), "arm had to wait for its limit 90% of the time"),
    ],
)
def test_words(wait: CpuWait, words: str) -> None:
    assert wait.is_late
    assert str(wait) == words


def test_short_waits_are_not_late() -> None:
    assert not CpuWait("camera", 12.0, throttled=5.0).is_late
    assert not CpuWait("camera").is_late


def test_a_few_nodes_are_enough() -> None:
    nodes = [CpuWait(f"n{number}", 50.0) for number in range(5)]
    assert format_cpu_waits(nodes).endswith(
        "; n2 waited 50% of the last minute for a CPU; 2 more waited"
    )
    assert format_cpu_waits(()) == ""


def test_remedies() -> None:
    waits = (
        CAMERA,
        CpuWait("arm", 50.0, throttled=50.0, rivals=(STRESS,)),
        CpuWait("", throttled=99.0),
    )
    assert wait_remedies(waits, "robot") == [
        "move the interrupts of xhci_hcd (/dev/video0) away from cpus 2-3: "
        "as root: echo 0-1 > /proc/irq/142/smp_affinity_list",
        "keep other processes away from cpus 2-3: AllowedCPUs= in their units, see "
        "systemd.resource-control(5)",
        "raise its CPU limit: doractl set robot --node arm:cpu_limit=CORES",
        "give arm CPUs of its own: cpus: below nodes: in its settings",
        "raise its CPU limit: doractl set robot --cpu-limit SHARE",
    ]


def test_values() -> None:
    assert CAMERA.values() == {
        "node": "camera",
        "waited_percent": 31.2,
        "span_us": 60 * SECOND,
        "throttled_percent": None,
        "cpus": "2-3",
        "processes": [STRESS.values()],
        "interrupts": [SHARED.values()],
    }

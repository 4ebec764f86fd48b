"""Interrupts of devices: parsed, found by device, compared with the CPUs of a node."""

import pytest

from dora_systemd.decisions.resources.interrupts import (
    Interrupt,
    Shared,
    interrupts_of_device,
    parse_cpu_list,
    parse_interrupts,
    share_interrupts,
)
from dora_systemd.values import parse_cpus

TEXT = """\
           CPU0       CPU1       CPU3
  1:          9          0          0   IO-APIC   1-edge      i8042
 16:         70          0          2   IO-APIC  16-fasteoi   ehci_hcd:usb1, snd_hda_intel:card0
142:          0          0       8012  PCI-MSIX-0000:00:14.0   0-edge      xhci_hcd
 27:         11         12         13     GICv2  27 Level     arch_timer
 30:          0          5          0     GICv2  60 Level     fe201000.serial
 50:          4          4          4  IO-APIC   5-edge
NMI:          1          2          3   Non-maskable interrupts
LOC:     100000     200000     300000   Local timer interrupts
ERR:          0
"""
XHCI = Interrupt(142, ("xhci_hcd",), 8012)
KNOWN = parse_interrupts(TEXT)


def test_lines() -> None:
    assert KNOWN[142] == XHCI
    assert KNOWN[16] == Interrupt(16, ("ehci_hcd:usb1", "snd_hda_intel:card0"), 72)
    assert KNOWN[50].total == 12
    assert sorted(KNOWN) == [1, 16, 27, 30, 50, 142], "none of the CPUs themselves"


@pytest.mark.parametrize("text", ["", "nonsense", "CPU0\n1:\n2: x\n", "\x00\n 1: -4 a"])
def test_other_text(text: str) -> None:
    assert parse_interrupts(text) == {}


@pytest.mark.parametrize(
    ("numbers", "places", "found"),
    [
        ({142, 999}, {"usb1"}, [142]),  # PCI says it, whatever the names
        ((), {"fe201000.serial", "tty"}, [30]),
        ((), {"usb1", "1-2"}, [16]),
        ((), {"video0"}, []),
    ],
)
def test_interrupts_of_a_device(numbers: set[int], places: set[str], found: list[int]) -> None:
    assert [one.number for one in interrupts_of_device(KNOWN, numbers, places)] == found


@pytest.mark.parametrize(
    ("text", "cpus"), [("0,2-3\n", "0,2-3"), ("", None), ("(null)", None), ("infinity", None)]
)
def test_lists_of_cpus(text: str, cpus: str | None) -> None:
    assert parse_cpu_list(text) == (parse_cpus(cpus) if cpus else 0)


def shared(cpus: str, *found: tuple[Interrupt, str]) -> list[Shared]:
    pairs = [(one, parse_cpus(own)) for one, own in found]
    online = parse_cpus("0-3")
    return list(share_interrupts("camera", "/dev/video0", parse_cpus(cpus), online, pairs))


def test_a_device_on_the_cpus_of_the_node() -> None:
    (one,) = shared("2-3", (XHCI, "3"))
    assert str(one) == "the interrupts of xhci_hcd (/dev/video0)"
    assert one.remedy == "as root: echo 0-1 > /proc/irq/142/smp_affinity_list"
    assert one.values() == {
        "needs": "/dev/video0",
        "names": ["xhci_hcd"],
        "interrupts": [142],
        "remedy": one.remedy,
    }


def test_a_device_elsewhere_or_silent() -> None:
    assert shared("2-3", (XHCI, "0-1")) == []
    assert shared("2-3", (XHCI._replace(total=0), "3")) == []
    assert shared("2-3") == []


def test_a_device_with_many() -> None:
    (one,) = shared("3", (XHCI, "3"), (Interrupt(143, ("xhci_hcd", "a", "b", "c"), 1), "0-3"))
    assert str(one) == "the interrupts of xhci_hcd, a, b (/dev/video0)"
    command = "for n in 142 143; do echo 0-2 > /proc/irq/$n/smp_affinity_list; done"
    assert one.remedy == f"as root: {command}"


def test_a_node_with_all_cpus() -> None:
    (one,) = shared("0-3", (Interrupt(9, (), 1), "3"))
    assert str(one) == "the interrupts of a driver (/dev/video0)"
    assert one.remedy == "give the node other cpus: in its settings"

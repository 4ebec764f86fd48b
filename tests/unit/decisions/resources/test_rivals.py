"""Who used the CPUs: from two samples of /proc."""

import pytest

from dora_systemd.decisions.resources.rivals import (
    MOST_RIVALS,
    Interrupt,
    ProcessTime,
    Rival,
    Shared,
    busiest,
    interrupts_of_device,
    on_cpus,
    parse_cpu_list,
    parse_interrupts,
    parse_stat,
    share_interrupts,
)
from dora_systemd.values import parse_cpus

FIELDS = "R 1 1 1 0 -1 4194304 90 0 0 0 120 30 0 0 20 0 1 0 77 4096 10"
TAIL = " ".join(["0"] * 14)
STAT = f"42 (a ) (b) {FIELDS} {TAIL} 3 0 0"


def test_a_line_of_stat() -> None:
    assert parse_stat(STAT) == ProcessTime("a ) (b", 150, 3)


@pytest.mark.parametrize("text", ["", "42 (x) R 1", "42 (x) " + "a " * 60, "no parentheses"])
def test_other_text(text: str) -> None:
    assert parse_stat(text) is None


def times(**ticks: int) -> dict[int, ProcessTime]:
    return {ord(name): ProcessTime(name, value, 0) for name, value in ticks.items()}


def test_the_busiest() -> None:
    before = times(a=100, b=0, c=7, d=50)
    now = times(a=112, b=25, c=8, d=99, e=400)
    found = busiest(before, now, 30.0, [ord("d")])
    assert found == [Rival(ord("b"), "b", 2500 / 30), Rival(ord("a"), "a", 40.0)]
    assert [str(one) for one in found] == ["process 98 (b, 83%)", "process 97 (a, 40%)"]
    assert busiest(now, before, 30.0, ()) == [], "a pid that another process has now"


def test_only_those_on_its_cpus() -> None:
    rivals = [Rival(pid, f"p{pid}", 90.0) for pid in range(6)]
    threads = {1: {2, 5}, 3: {0}, 4: {3}}
    assert [one.pid for one in on_cpus(rivals, threads, {2, 3})] == [1, 4]
    assert len(on_cpus(rivals, threads, ())) == MOST_RIVALS


def test_a_node_of_a_dataflow() -> None:
    rival = Rival(7, "python3", 55.55, "detector of robot")
    assert str(rival) == "process 7 (node detector of robot, 56%)"
    assert rival.values() == {
        "pid": 7,
        "command": "python3",
        "cpu_percent": 55.5,
        "node": "detector of robot",
    }


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
def test_other_text_of_interrupts(text: str) -> None:
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

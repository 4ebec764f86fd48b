"""CPU time of this process, from the real /proc and from one of files."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.host.rivals import Interrupts, read_delay, read_thread_cpus, read_times
from dora_systemd.values import cpu_numbers


def test_the_processes_of_this_machine() -> None:
    mine = read_times()[os.getpid()]
    assert mine.ticks >= 0
    assert read_thread_cpus(os.getpid()) <= frozenset(range(os.cpu_count() or 1))
    assert read_thread_cpus(os.getpid())


def test_delays_of_all_threads(tmp_path: Path) -> None:
    for thread, text in ((7, "9 1000 3\n"), (8, "9 500 3\n"), (9, "")):
        path = tmp_path / f"7/task/{thread}/schedstat"
        path.parent.mkdir(parents=True)
        path.write_text(text)
    assert read_delay([7, 99], tmp_path) == 1500


def test_no_processes(tmp_path: Path) -> None:
    (tmp_path / "7").mkdir()
    assert read_times(tmp_path) == {}
    assert read_thread_cpus(7, tmp_path) == frozenset()


TEXT = """\
      CPU0  CPU1
 20:     4     0   IO-APIC  20-fasteoi   ohci_hcd:usb3
142:     0  8012  PCI-MSIX-0000:00:14.0   0-edge      xhci_hcd
 30:     9     0     GICv2  60 Level     can0
"""
USB = "sys/devices/pci0000:00/0000:00:14.0"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A machine with a camera at a PCI controller, an old one, and an interface without PCI."""
    write(tmp_path / "proc/interrupts", TEXT)
    write(tmp_path / "sys/devices/system/cpu/online", "0-1\n")
    write(tmp_path / USB / "msi_irqs/142", "msix\n")
    add(tmp_path, f"{USB}/usb1/1-2/video4linux/video0", "sys/dev/char/81:0")
    write(tmp_path / "sys/devices/pci0000:00/0000:00:15.0/irq", "20\n")
    add(tmp_path, "sys/devices/pci0000:00/0000:00:15.0/usb3/block/sda", "sys/dev/block/8:0")
    add(tmp_path, "sys/devices/platform/c310000.mttcan/net/can0", "sys/class/net/can0")
    for number, kind, cpus in ((142, "effective_affinity", "1"), (30, "smp_affinity", "0-1")):
        write(tmp_path / f"proc/irq/{number}/{kind}_list", f"{cpus}\n")
    write(tmp_path / "proc/irq/142/smp_affinity_list", "0-1\n")
    return tmp_path


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def add(root: Path, device: str, link: str) -> None:
    """A device, and the link that leads there."""
    (root / device).mkdir(parents=True)
    (root / link).parent.mkdir(parents=True, exist_ok=True)
    (root / link).symlink_to(root / device)


def plain(found: list[tuple[object, int]]) -> list[tuple[object, list[int]]]:
    return [(getattr(one, "number", 0), cpu_numbers(cpus)) for one, cpus in found]


def test_devices(root: Path) -> None:
    interrupts = Interrupts(root)
    assert cpu_numbers(interrupts.online) == [0, 1]
    assert plain([*interrupts.of_number(os.makedev(81, 0), False)]) == [(142, [1])]
    assert plain([*interrupts.of_number(os.makedev(8, 0), True)]) == [(20, [])]
    assert plain([*interrupts.of_interface("can0")]) == [(30, [0, 1])]


def test_what_is_no_device_has_none(root: Path) -> None:
    (root / "sys/class/net/odd").symlink_to("/etc")
    interrupts = Interrupts(root)
    assert interrupts.of_number(os.makedev(9, 9), False) == []
    assert [interrupts.of_interface(name) for name in ("vcan0", "odd")] == [[], []]
    assert Interrupts(root / "nothing").of_interface("can0") == []

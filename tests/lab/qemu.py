"""The emulator: its command line, its life, and its monitor."""

import json
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lab.emulator import firmware, program
from lab.errors import LabError
from lab.process import die_with_parent, read_last_line
from lab.runs import CONSOLE
from lab.slow import slowed

KERNEL_OPTIONS = (
    "rw console=ttyS0 mitigations=off quiet loglevel=3 random.trust_cpu=on tsc=reliable nokaslr"
    " panic=1"
)


# A machine with a kernel in user mode locks the whole image below, which nobody writes to.
UNLOCKED = "backing.file.locking=off"


def machine_command(
    emulator: Path, layer: Path, disk: Path, place: Path, snapshot: str, memory: str
) -> list[str]:
    """Never with KVM: where it exists without working, the machine hangs."""
    load = ["-loadvm", snapshot] if snapshot else []
    return die_with_parent([
        *program(emulator, "qemu-system-x86_64"), *firmware(emulator),
        "-M", "pc", "-accel", "tcg,thread=multi", "-cpu", "max",
        "-smp", "2", "-m", memory, "-nodefaults", "-no-user-config", "-display", "none",
        "-kernel", str(layer / "vmlinuz"), "-initrd", str(layer / "initrd"),
        "-append", KERNEL_OPTIONS,
        "-drive", f"file={disk},if=none,id=disk,format=qcow2,cache=unsafe,{UNLOCKED}",
        "-device", "virtio-blk-pci,drive=disk",
        "-device", "virtio-serial-pci",
        "-chardev", f"socket,id=agent,path={place / 'agent'},server=on,wait=on",
        "-device", "virtserialport,chardev=agent,name=lab",
        "-chardev", f"file,id=console,path={place / CONSOLE}",
        "-serial", "chardev:console",
        "-qmp", f"unix:{place / 'qmp'},server=on,wait=off",
        *load,
    ])  # fmt: skip


@contextmanager
def started(command: Sequence[str], place: Path, speed: int) -> Iterator[socket.socket]:
    """The agent's port. The emulator waits for it to be opened, then starts the machine.

    speed: percent of the time that it runs.
    """
    with (place / "log").open("wb") as log:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
        )
    try:
        port = connect(place / "agent", process, place / "log")
        with slowed(process, speed):
            yield port
    finally:
        process.kill()
        process.wait()


def connect(path: Path, process: subprocess.Popen[bytes], log: Path) -> socket.socket:
    port = socket.socket(socket.AF_UNIX)
    for _ in range(1000):
        if process.poll() is not None:
            break
        try:
            port.connect(str(path))
            return port
        except OSError:
            time.sleep(0.01)
    raise LabError(f"start the machine: {read_last_line(log)}", "is there memory for it?")


def ask_monitor(place: Path, command: str) -> None:
    with socket.socket(socket.AF_UNIX) as monitor:
        monitor.connect(str(place / "qmp"))
        lines = monitor.makefile("rw", encoding="utf-8")
        lines.readline()  # its greeting
        ask(lines, {"execute": "qmp_capabilities"})
        arguments = {"command-line": command}
        said = ask(lines, {"execute": "human-monitor-command", "arguments": arguments})
    if said:
        raise LabError(f"{command}: {said}")


def ask(lines: Any, request: dict[str, Any]) -> str:
    lines.write(json.dumps(request) + "\n")
    lines.flush()
    while True:
        answer = json.loads(lines.readline())
        if "error" in answer:
            raise LabError(f"ask the emulator: {answer['error']['desc']}")
        if "return" in answer:
            return str(answer["return"] or "").strip()

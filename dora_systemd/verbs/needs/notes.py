"""What people are told about the needs of a dataflow, and which service waits for the clock."""

from collections.abc import Iterator
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.cell.needs import CLOCK, NodeNeed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.needs.awaited import format_awaited
from dora_systemd.decisions.needs.devices import lone_devices
from dora_systemd.decisions.needs.units import CLOCK_WAITERS
from dora_systemd.decisions.needs.words import START, WAITS, format_wait
from dora_systemd.names import unit_name
from dora_systemd.values import shown

_UNIT_PATHS = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
_GROUPS = ("char-", "block-")
_HIDDEN = ("/tmp/", "/var/tmp/")


def clock_service() -> str:
    """The service of this machine that waits until the clock is right, or ""."""
    for one in CLOCK_WAITERS:
        if any(Path(place, one).exists() for place in _UNIT_PATHS):
            return one
    return ""


def needs_warnings(
    needs: tuple[str, ...], nodes: tuple[NodeNeed, ...], has_mounts: bool, allowed: tuple[str, ...]
) -> Iterator[str]:
    """Warnings about needs that nothing here meets.

    has_mounts: the sandbox has a /tmp of its own, and closes devices. allowed: DeviceAllow= of the
    settings.
    """
    if CLOCK in needs and not clock_service():
        yield "nothing waits for the clock: neither systemd-timesyncd nor chrony is installed"
    if has_mounts:
        yield from _sandbox_warnings(nodes, allowed)


def _sandbox_warnings(nodes: tuple[NodeNeed, ...], allowed: tuple[str, ...]) -> Iterator[str]:
    for node, path in nodes:
        if path.startswith(_HIDDEN):
            yield f"node {node} waits for {shown(path)}, but the sandbox has its own /tmp"
    if any(one.startswith(_GROUPS) for one in allowed):
        return  # probably that of the device: which one it has is only known when it is there
    for node, path in lone_devices(nodes):
        reason = "the sandbox opens it only if it is there at the start"
        hint = "name its group of /proc/devices, such as --device char-GROUP"
        yield f"node {node} waits for {shown(path)}, but {reason}; {hint}"


def held_notes(manager: Manager, name: str) -> Iterator[str]:
    """What a start that nobody has waited for waits for, while systemd holds it."""
    if needs := format_awaited(manager.awaited(unit_name(name))):
        yield format_wait(START, needs, 0)


def waiting_notes(manager: Manager, options: RunnerOptions) -> Iterator[str]:
    """What a dataflow that has been started waits for, in the words of the runner."""
    if options.needs:
        text = str(manager.read(unit_name(options.name), ["StatusText"])["StatusText"])
        if WAITS in text:
            yield text

"""The needs of a dataflow: checks before its start, and notes to the caller.

The needed units have to exist, and must not wait in a circle.
"""

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.needs.units import (
    CLOCK_WAITERS,
    format_awaited,
    lone_devices,
    needed_mounts,
    required_units,
)
from dora_systemd.decisions.needs.waiting import START, WAITS, format_wait
from dora_systemd.decisions.needs.words import CLOCK, DATAFLOW, MOUNT, NET, NETWORK, NodeNeed
from dora_systemd.decisions.properties.sandbox import Sandbox
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import name_from_unit, unit_name
from dora_systemd.values import shown

_MOST = 200
"""Maximum units that are checked for a circle."""
_UNIT_PATHS = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
_GROUPS = ("char-", "block-")
_HIDDEN = ("/tmp/", "/var/tmp/")


class Needy(NamedTuple):
    """A dataflow with needs."""

    name: str  # of the dataflow
    is_user: bool  # in a user's manager
    needs: tuple[str, ...]


def check_needs(manager: Manager, plan: Needy) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a need that can never be met."""
    needs = plan.needs
    if not needs:
        return
    _check_scope(plan, needs)
    for need, unit in required_units(needs).items():
        _check_circle(manager, plan, need, unit)
        _check_unit(manager, plan, need, unit)
    for path in needed_mounts(needs):
        _check_mount(manager, plan, path)


def _check_scope(plan: Needy, needs: tuple[str, ...]) -> None:
    """A user's manager has no units for the network, the clock and file systems."""
    words = (NETWORK, CLOCK)
    absent = [one for one in needs if one in words or one.startswith(MOUNT)]
    if plan.is_user and absent:
        raise _refusal(plan, absent[0], "a user's manager does not know that", "add --system")


def _check_unit(manager: Manager, plan: Needy, need: str, unit: str) -> None:
    state = str(manager.read(unit, ["LoadState"])["LoadState"])
    if state == "loaded":
        return
    if not need.startswith(DATAFLOW):
        raise _refusal(plan, need, f"unit {unit} is {state}", "see systemctl list-unit-files")
    name = need.removeprefix(DATAFLOW)
    # Its needs are unknown: each of a circle that was never started is refused for the next one.
    hint = (
        f"start {name} first, with --enable to start it at boot, too; "
        f"if {name} needs {plan.name}, they wait for each other: remove one of these needs"
    )
    raise _refusal(plan, need, f"no dataflow named '{name}'", hint)


def _check_circle(manager: Manager, plan: Needy, need: str, unit: str) -> None:
    """Follow the dependencies of dataflows; systemd would silently drop one of a circle."""
    chain, left = {unit: [unit]}, [unit]
    while left and len(chain) < _MOST:
        one = left.pop()
        if one == unit_name(plan.name):
            names = [name_from_unit(each) or each for each in (unit_name(plan.name), *chain[one])]
            reason = f"they wait for each other: {' -> '.join(names)}"
            raise _refusal(plan, need, reason, "remove one of these needs")
        needed = manager.read(one, ["Requires"])["Requires"] if name_from_unit(one) else ()
        fresh = [each for each in needed if name_from_unit(each) and each not in chain]
        chain |= {each: [*chain[one], each] for each in fresh}
        left += fresh


def _check_mount(manager: Manager, plan: Needy, path: str) -> None:
    """A path needs a unit that mounts it: without one, systemd would wait for nothing."""
    places = [PurePosixPath(path), *PurePosixPath(path).parents][:-1]
    if not any(_is_mount(manager, str(place)) for place in places):
        # Not "nothing is mounted": systemd has no units for /, /proc and the like.
        reason = f"systemd has no mount unit for {shown(path)}, or for a directory above it"
        raise _refusal(plan, f"{MOUNT}{path}", reason, "add it to /etc/fstab, see fstab(5)")


def _is_mount(manager: Manager, path: str) -> bool:
    unit = f"{_escaped(path)}.mount"
    return bool(manager.read(unit, ["LoadState"])["LoadState"] == "loaded")


def _escaped(path: str) -> str:
    """Escape a path as systemd-escape(1) --path does."""
    text = "".join(map(_escaped_byte, path.strip("/").encode()))
    return f"\\x2e{text[1:]}" if text.startswith(".") else text


def _escaped_byte(byte: int) -> str:
    if byte == ord("/"):
        return "-"
    is_kept = byte < 128 and (chr(byte).isalnum() or chr(byte) in ":_.")
    return chr(byte) if is_kept else f"\\x{byte:02x}"


def _refusal(plan: Needy, need: str, reason: str, hint: str) -> DoraSystemdError:
    return bad_input(f"cannot start {plan.name}: it needs {need}: {reason}", hint)


def clock_service() -> str:
    """The service of this machine that waits until the clock is right, or ""."""
    for one in CLOCK_WAITERS:
        if any(Path(place, one).exists() for place in _UNIT_PATHS):
            return one
    return ""


def needs_warnings(
    needs: tuple[str, ...], nodes: tuple[NodeNeed, ...], sandbox: Sandbox, allowed: tuple[str, ...]
) -> Iterator[str]:
    """Yield warnings about needs that nothing on this machine meets.

    allowed: DeviceAllow= of the settings.
    """
    if CLOCK in needs and not clock_service():
        yield "nothing waits for the clock: neither systemd-timesyncd nor chrony is installed"
    if sandbox.network == "private":
        for node, what in nodes:
            if what.startswith(NET) and what != f"{NET}lo":
                yield f"node {node} waits for {what}, but a private network has only net:lo"
    if sandbox.has_mounts:
        yield from _sandbox_warnings(nodes, allowed)


def _sandbox_warnings(nodes: tuple[NodeNeed, ...], allowed: tuple[str, ...]) -> Iterator[str]:
    for node, path in nodes:
        if path.startswith(_HIDDEN):
            yield f"node {node} waits for {shown(path)}, but the sandbox has its own /tmp"
    if any(one.startswith(_GROUPS) for one in allowed):
        return  # probably the group of the device, which is only known when the device exists
    for node, path in lone_devices(nodes):
        reason = "the sandbox opens it only if it is there at the start"
        hint = "name its group of /proc/devices, such as --device char-GROUP"
        yield f"node {node} waits for {shown(path)}, but {reason}; {hint}"


def held_notes(manager: Manager, name: str) -> Iterator[str]:
    """Yield what a start with --no-wait waits for, while systemd holds the start."""
    if needs := format_awaited(manager.awaited(unit_name(name))):
        yield format_wait(START, needs, 0)


def waiting_notes(manager: Manager, options: RunnerOptions) -> Iterator[str]:
    """Yield what a started dataflow waits for, from its STATUS=."""
    if options.has("needs"):
        text = str(manager.read(unit_name(options.name), ["StatusText"])["StatusText"])
        if WAITS in text:
            yield text

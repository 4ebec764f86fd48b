"""`link: direct`: zenoh between machines without ssh, on addresses that somebody has chosen. Pure.

zenoh of dora has no password and no encryption. So it listens on these addresses and no others, and
the units exchange packets with them and with no others, see decisions/unit/properties.py.
"""

from collections.abc import Callable, Sequence

from dora_systemd.decisions.machines.entry import DIRECT, Machine
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import shown

Route = Callable[[str, str], str]
"""The address of the head from which it reaches another one, or "" if it cannot. The second one: it
has to be this, unless it is ""."""


def direct_addresses(used: Sequence[Machine], route: Route, source: str) -> tuple[str, ...]:
    """The addresses of head and members, in this order; () if ssh carries the messages.

    used: the members of a dataflow. route: of the head. source: the dataflow file. Raises
    DoraSystemdError (BAD_INPUT) for machines that cannot meet like this.
    """
    direct = [one for one in used if one.link == DIRECT]
    if not direct:
        return ()
    for other in used:
        if other.link != DIRECT:
            reason = f"the link of machine {direct[0].name} is direct, that of {other.name} is not"
            raise _refusal(source, reason, "give all machines of the dataflow the same link")
    found = {"head": _head_address(direct, route, source)}
    found |= {one.name: one.address for one in direct}
    _check_different(found, source)
    return tuple(found.values())


def _head_address(direct: Sequence[Machine], route: Route, source: str) -> str:
    """The one address of the head: its daemon listens on one only."""
    first, *others = direct
    address = _reached_from(first, route, source)
    for other in others:
        if (another := _reached_from(other, route, source)) != address:
            reason = f"the head reaches machine {first.name} from {address}, and {other.name}"
            hint = "give all machines addresses in one network, or the same head_address"
            raise _refusal(source, f"{reason} from {another}", hint)
    return address


def _reached_from(machine: Machine, route: Route, source: str) -> str:
    if found := route(machine.address, machine.head_address):
        return found
    start = f" from {machine.head_address}" if machine.head_address else ""
    reason = f"the head cannot reach address {machine.address} of machine {machine.name}{start}"
    raise _refusal(source, reason, f"see: ip route get {machine.address}")


def _check_different(found: dict[str, str], source: str) -> None:
    seen: dict[str, str] = {}
    for name, address in found.items():
        if address in seen:
            reason = f"{seen[address]} and {name} have the same address {address}"
            raise _refusal(source, reason, "write the address that each machine has of its own")
        seen[address] = name


def _refusal(source: str, reason: str, hint: str) -> DoraSystemdError:
    return DoraSystemdError(f"cannot start {shown(source)}: {reason}", hint, ExitCode.BAD_INPUT)

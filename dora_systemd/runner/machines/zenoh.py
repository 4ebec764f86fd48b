"""How the daemons of several machines meet. Imports only what loads quickly.

addresses: of the options; the daemon of a machine listens on the first one.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.machines.address import LOOPBACK, endpoint
from dora_systemd.decisions.machines.wire import Forwards, Part

_ZENOH = Path(__file__).parents[2] / "zenoh-machines.json5"
_NO_DIRECT = {"DORA_ZENOH_ENDPOINT_EXCHANGE_TIMEOUT_MS": "0"}
"""Where ssh carries the messages, nodes of different machines do not dial each other: the addresses
would be those of 127.0.0.1. So dora must not wait for them either; it would for 1.5 s."""
_OVERLAYS = ("ZENOH_CONFIG", "DORA_ZENOH_CONFIG_OVERLAY")
"""Variables by which a user sets the same: dora refuses both."""


def shared_environment(environment: Mapping[str, str], addresses: Sequence[str]) -> dict[str, str]:
    """The environment of dora's processes."""
    return {**environment, **({} if addresses else _NO_DIRECT)}


def head_arguments(
    ports: Forwards, environment: Mapping[str, str], addresses: Sequence[str]
) -> tuple[str, ...]:
    """What the daemon of the head needs to meet those of other machines."""
    return _arguments(ports.zenoh[HEAD], environment, addresses)


def member_arguments(
    part: Part, environment: Mapping[str, str], addresses: Sequence[str]
) -> tuple[str, ...]:
    """The same for the daemon of a member, which also needs its name."""
    return ("--machine-id", part.machine, *_arguments(part.zenoh, environment, addresses))


def _arguments(
    port: int, environment: Mapping[str, str], addresses: Sequence[str]
) -> tuple[str, ...]:
    has_own = any(name in environment for name in _OVERLAYS)
    overlay = () if has_own else ("--zenoh-config-overlay", str(_ZENOH))
    return ("--zenoh-listen", endpoint([*addresses, LOOPBACK][0], port), *overlay)

"""The packets that a unit exchanges if zenoh reaches other machines without ssh. Pure."""

from collections.abc import Sequence

from dora_systemd.decisions.needs.units import NETWORK_UNIT
from dora_systemd.decisions.properties.assignments import with_assignments
from dora_systemd.decisions.properties.kinds import Property


def address_properties(addresses: Sequence[str], is_user: bool) -> dict[str, Property]:
    """Packets to and from these machines only, see systemd.resource-control(5).

    addresses: of all machines; () if they do not meet like this. A user's manager can neither
    filter packets nor wait for the network.
    """
    if not addresses or is_user:
        return {}
    lines = ["IPAddressDeny=any", "IPAddressAllow=localhost"]
    lines += [f"IPAddressAllow={one}" for one in addresses]
    lines += [f"{key}={NETWORK_UNIT}" for key in ("Wants", "After")]
    return with_assignments({}, lines)

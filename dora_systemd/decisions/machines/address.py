"""The address of a machine on which zenoh listens, with `link: direct`. Pure."""

import ipaddress

from dora_systemd.errors import usage_error
from dora_systemd.values import quoted

LOOPBACK = "127.0.0.1"
"""Where all of dora listens if ssh carries the messages."""
_WORDS = {
    "is_unspecified": "it means every address of the machine",
    "is_multicast": "it is for multicast",
    "is_loopback": "no other machine reaches it",
    "is_link_local": "it counts for one network card only",
    "is_reserved": "it is reserved",
}


def parse_address(text: str) -> str:
    """An IP address on which a machine can listen for others, as ipaddress writes it.

    Raises DoraSystemdError (USAGE) for all others.
    """
    if reason := _problem(text):
        hint = "write the address of that machine in a network that only your machines are in"
        raise usage_error(f"cannot use address {quoted(text)}: {reason}", hint)
    return str(ipaddress.ip_address(text))


def _problem(text: str) -> str:
    try:
        found = ipaddress.ip_address(text)
    except ValueError:
        return "it is no IP address"
    if isinstance(found, ipaddress.IPv6Address) and (found.ipv4_mapped or found.scope_id):
        return "it is an address of another kind"
    return next((words for kind, words in _WORDS.items() if getattr(found, kind)), "")


def endpoint(address: str, port: int) -> str:
    """Format an address and a port for --zenoh-listen of dora."""
    return f"[{address}]:{port}" if ":" in address else f"{address}:{port}"

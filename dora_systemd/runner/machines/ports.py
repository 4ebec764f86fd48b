"""The ports of a dataflow with several machines: those of 127.0.0.1 are the same on all of them."""

import os
from collections.abc import Sequence
from errno import EADDRINUSE

from dora_systemd.adapters.host.addresses import listen_error, port_error
from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.machines.wire import PORT_RANGE, Forwards
from dora_systemd.errors import DoraSystemdError


def choose_ports(
    members: Sequence[str], addresses: Sequence[str] = (), ports: Sequence[int] = PORT_RANGE
) -> Forwards:
    """Ports that are free here, other ones each time. Raises DoraSystemdError if there are none.

    addresses: of the options; the daemon here listens on the first one.
    """
    begin = int.from_bytes(os.urandom(4)) % len(ports)
    turned = (*ports[begin:], *ports[:begin])
    own = addresses[:1]
    free = (
        port
        for port in turned
        if not port_error(port) and not any(listen_error(one, port) == EADDRINUSE for one in own)
    )
    try:
        return Forwards(next(free), {one: next(free) for one in (HEAD, *members)})
    except StopIteration:
        message = f"cannot find free ports from {ports[0]} to {ports[-1]}"
        raise DoraSystemdError(message, "see: ss -ltn") from None

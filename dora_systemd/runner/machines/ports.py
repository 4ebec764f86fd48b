"""The ports of a dataflow with several machines: those of 127.0.0.1 are the same on all of them."""

import random
from collections.abc import Sequence
from errno import EADDRINUSE

from dora_systemd.adapters.host.addresses import listen_error
from dora_systemd.adapters.host.loopback import port_error
from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.machines.wire import PORT_RANGE, Forwards
from dora_systemd.errors import DoraSystemdError


def choose_ports(members: Sequence[str], addresses: Sequence[str] = ()) -> Forwards:
    """Ports that are free here, other ones each time. Raises DoraSystemdError if there are none.

    addresses: of the options; the daemon here listens on the first one.
    """
    shuffled = random.sample(PORT_RANGE, len(PORT_RANGE))
    own = addresses[:1]
    free = (
        port
        for port in shuffled
        if not port_error(port) and not any(listen_error(one, port) == EADDRINUSE for one in own)
    )
    try:
        return Forwards(next(free), {one: next(free) for one in (HEAD, *members)})
    except StopIteration:
        message = f"cannot find free ports from {PORT_RANGE.start} to {PORT_RANGE.stop - 1}"
        raise DoraSystemdError(message, "see: ss -ltn") from None

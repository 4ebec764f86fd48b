"""The ports of 127.0.0.1 that are the same on all machines of a dataflow."""

import os
from collections.abc import Sequence

from dora_systemd.adapters.host.loopback import port_error
from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.machines.wire import PORT_RANGE, Forwards
from dora_systemd.errors import DoraSystemdError


def choose_ports(members: Sequence[str]) -> Forwards:
    """Ports that are free here, other ones each time. Raises DoraSystemdError if there are none."""
    begin = int.from_bytes(os.urandom(4)) % len(PORT_RANGE)
    turned = (*PORT_RANGE[begin:], *PORT_RANGE[:begin])
    free = (port for port in turned if not port_error(port))
    try:
        return Forwards(next(free), {one: next(free) for one in (HEAD, *members)})
    except StopIteration:
        message = f"cannot find free ports from {PORT_RANGE.start} to {PORT_RANGE.stop - 1}"
        raise DoraSystemdError(message, "see: ss -ltn") from None

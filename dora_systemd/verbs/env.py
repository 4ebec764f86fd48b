"""`doractl env`: variables by which a dora command finds the gateway, or one dataflow."""

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.dora.variables import coordinator_variables
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.gateway import read_token, require_gateway
from dora_systemd.verbs.node import dora_environment, reached_coordinator


def read_variables(manager: Manager, scope: Scope, selector: str | None) -> dict[str, str]:
    """The variables by name; with `selector` those of that dataflow instead of the gateway.

    Raises DoraSystemdError: NOT_RUNNING, NOT_FOUND, NO_PERMISSION for another user's dataflow, or
    USAGE for one with a private network.
    """
    if selector is None:
        port = require_gateway(manager, scope)
        return coordinator_variables(port, read_token(scope, port))
    cell = Selector(selector).find(manager)
    return dora_environment(reached_coordinator(scope, manager, cell))

"""`doractl env`, and the state of the gateway as systemd knows it, and its token."""

from dataclasses import dataclass

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.addresses import answers_health
from dora_systemd.decisions.dora.command import coordinator_variables
from dora_systemd.decisions.gateway.place import SOCKET_UNIT, port_of, token_path
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import dora_environment, reached_coordinator

_READY_SECONDS = 30.0


@dataclass(frozen=True)
class Gateway:
    """Whether the gateway's port is open."""

    is_up: bool
    port: int | None  # None if it has no unit


def read_gateway(manager: Manager) -> Gateway:
    """Whether the port is open, and its number."""
    facts = manager.read(SOCKET_UNIT, ["LoadState", "ActiveState"])
    if facts["LoadState"] != "loaded":
        return Gateway(False, None)
    port = port_of(manager.read(SOCKET_UNIT, ["Listen"])["Listen"])
    return Gateway(facts["ActiveState"] == "active", port)


def require_gateway(manager: Manager, scope: Scope) -> int:
    """The port. Raises DoraSystemdError (NOT_RUNNING) if the gateway is not up."""
    gateway = read_gateway(manager)
    if not gateway.is_up or gateway.port is None:
        hint = f"{scope.command} up"
        raise DoraSystemdError("cannot use the gateway: it is not up", hint, ExitCode.NOT_RUNNING)
    return gateway.port


def check_answer(scope: Scope, port: int) -> None:
    """Return once the gateway answers. Raises DoraSystemdError if it does not."""
    if not answers_health(port, _READY_SECONDS):
        which = "--user-unit" if scope.is_user else "--unit"
        raise DoraSystemdError(
            f"cannot get an answer from the gateway on port {port}",
            f"journalctl {which} dora-gateway.service -e",
        )


def read_token(scope: Scope, port: int) -> str:
    """The gateway's token. Raises DoraSystemdError (NO_PERMISSION) for another user's gateway."""
    path = token_path(scope)
    try:
        if not path.exists():
            # The gateway creates the token when the first connection starts it.
            check_answer(scope, port)
        return path.read_text().strip()
    except PermissionError as error:
        raise DoraSystemdError(
            f"cannot read {path}: permission denied",
            "use sudo, or --user for a gateway of your own",
            ExitCode.NO_PERMISSION,
        ) from error
    except (OSError, ValueError) as error:
        raise DoraSystemdError(
            f"cannot read {path}", f"systemctl {scope.flag} restart {SOCKET_UNIT}"
        ) from error


def read_variables(manager: Manager, scope: Scope, selector: str | None) -> dict[str, str]:
    """The variables by name; with `selector` those of that dataflow instead of the gateway.

    Raises DoraSystemdError: NOT_RUNNING, NOT_FOUND, NO_PERMISSION for another user's dataflow, or
    USAGE for one with a private network.
    """
    if selector is None:
        port = require_gateway(manager, scope)
        return coordinator_variables(port, read_token(scope, port))
    cell = Selector(selector).find_present(manager, scope)
    return dora_environment(reached_coordinator(scope, manager, cell))

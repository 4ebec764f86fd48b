"""The variables by which the dora command finds a coordinator, as lines for a shell. Pure."""

import shlex
from collections.abc import Iterable, Mapping

VARIABLES = (
    "DORA_COORDINATOR_ADDR",
    "DORA_COORDINATOR_PORT",
    "DORA_AUTH_TOKEN",
    "DORA_DAEMON_LOCAL_LISTEN_PORT",
)
"""The variables that dora 1.1 reads and `doractl env` sets; the last one is for dynamic nodes."""

SHELLS = {"sh": ("export {0}={1}", "unset {0}"), "fish": ("set -gx {0} {1}", "set -e {0}")}
"""Commands that set and unset a variable. sh: also for bash and zsh."""


def coordinator_variables(
    port: int, token: str, local_listen_port: int | None = None
) -> dict[str, str]:
    """The variables for a coordinator on this port of 127.0.0.1."""
    values = ("127.0.0.1", str(port), token)
    found = dict(zip(VARIABLES, values, strict=False))
    return found if local_listen_port is None else {**found, VARIABLES[-1]: str(local_listen_port)}


def format_exports(shell: str, values: Mapping[str, str]) -> str:
    """Lines that set these variables and unset the others of VARIABLES."""
    set_line, _ = SHELLS[shell]
    lines = [set_line.format(name, shlex.quote(value)) for name, value in values.items()]
    others = [name for name in VARIABLES if name not in values]
    return "\n".join([*lines, *([format_unsets(shell, others)] if others else [])])


def format_unsets(shell: str, names: Iterable[str] = VARIABLES) -> str:
    """Commands that unset them."""
    return "\n".join(SHELLS[shell][1].format(name) for name in names)

"""The command line of a link, and that of its ssh(1). Pure.

doractl writes the command line of a link, so that the user of the nodes cannot choose what root
runs on another machine. The link is a process for as long as the dataflow runs: this module imports
only what is small.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.machines.wire import PORT_RANGE, Forwards
from dora_systemd.decisions.remote.hosts import Way, parse_host, remote_command
from dora_systemd.errors import DoraSystemdError, bad_input, usage_error

_PROGRAMS = Path(__file__).parents[2] / "link"
_QUICK = ("-I", "-S")
"""Without site-packages Python starts in half the time, and both programs need none."""
RESTRICTED = "--restricted"
"""The option of `doractl member` that a link gives if it has the key of `machine add`."""
_KEYS = ("socket", "machine", "host", "identity")
_MOST_MACHINES = 64
_OPTIONS = {
    "BatchMode": "yes",
    "ExitOnForwardFailure": "yes",
    # Later than the lease: after a gap of 4 s TCP needs two more to send again.
    "ServerAliveInterval": "2",
    "ServerAliveCountMax": "5",
    # Also for the first words of sshd, on a machine that is busy.
    "ConnectTimeout": "8",
    # No shared connection, even if ssh_config(5) configures one.
    "ControlMaster": "no",
    "ControlPath": "none",
    "ClearAllForwardings": "no",
    "GatewayPorts": "no",
    "ForwardAgent": "no",
    "ForwardX11": "no",
    "RemoteCommand": "none",
    # The sandbox of the link lets it write nothing.
    "UpdateHostKeys": "no",
    "LogLevel": "ERROR",
}


class LinkOptions(NamedTuple):
    """The command line of a link."""

    socket: str  # absolute path, of the head's runner
    machine: str  # the member
    host: str  # for ssh(1), as in -H
    words: tuple[str, ...]  # the arguments of doractl on the member
    identity: str = ""  # a file with a key, or ""


def link_command(python: str, link: LinkOptions) -> list[str]:
    """ExecStart= of the unit. python: absolute path of the interpreter of dora-systemd."""
    own = [f"--{key}={getattr(link, key)}" for key in _KEYS]
    return [python, *_QUICK, str(_PROGRAMS / "run.py"), *own, *link.words]


def relay_command(python: str, runner: int, lease: float) -> list[str]:
    """Return the command that replaces `doractl member`. runner: descriptor. lease: seconds."""
    return [python, *_QUICK, str(_PROGRAMS / "relay.py"), str(runner), f"{lease:g}"]


def parse_link_command(argv: Sequence[str]) -> LinkOptions:
    """The options in an ExecStart= of link_command(). Raises DoraSystemdError (USAGE)."""
    first = f"--{_KEYS[0]}="
    begin = next((number for number, word in enumerate(argv) if word.startswith(first)), 0)
    return parse_link_argv(argv[begin:])


def parse_link_argv(arguments: Sequence[str]) -> LinkOptions:
    """The options in the arguments of link_command(). Raises DoraSystemdError (USAGE)."""
    pairs = [one.partition("=") for one in arguments[: len(_KEYS)]]
    words = tuple(arguments[len(_KEYS) :])
    socket = pairs[0][2] if pairs else ""
    if [key for key, _, _ in pairs] != [f"--{key}" for key in _KEYS] or not words:
        raise _no_link()
    if not socket.startswith("/"):
        raise _no_link()
    _, machine, host, identity = (value for _, _, value in pairs)
    return LinkOptions(socket, machine, host, words, identity)


def ssh_link_arguments(link: LinkOptions, forwards: Forwards, mark: str) -> list[str]:
    """Return the arguments of ssh(1). mark: printed first, see Way.

    The numbers of ports are the same at both ends, so the addresses that dora announces are true on
    each machine. Raises DoraSystemdError (BAD_INPUT) for ports that are not safe to forward, and
    for an invalid host.
    """
    check_forwards(forwards, link.machine)
    host = parse_host(link.host)
    own = [port for name, port in forwards.zenoh.items() if name == link.machine]
    to_member = (port for name, port in forwards.zenoh.items() if name != link.machine)
    words = [f"-o{key}={value}" for key, value in _OPTIONS.items()]
    words += [f"-R{_same(port)}" for port in (forwards.coordinator, *to_member)]
    words += [f"-L{_same(port)}" for port in own]
    words += [f"-i{link.identity}", "-oIdentitiesOnly=yes"] if link.identity else []
    words += [f"-p{host.port}"] if host.port else []
    command = remote_command(Way.FED, member_words(link), mark)
    return ["-T", *words, "--", host.destination, command]


def member_words(link: LinkOptions) -> list[str]:
    """Return the arguments of doractl on the member, with the member's name on the head.

    A link with its own key adds RESTRICTED: ssh also tries the keys that ssh_config(5) names, and
    with such a key the account could run any command.
    """
    verb, *rest = link.words
    restricted = [RESTRICTED] if link.identity else []
    return [verb, *restricted, f"--as={link.machine}", *rest]


def check_forwards(forwards: Forwards, machine: str) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for ports that a link does not forward.

    The runner, whom the user of the nodes can replace, chooses them. All of its users can reach the
    ports on both machines, so none may be that of a usual service.
    """
    ports = [forwards.coordinator, *forwards.zenoh.values()]
    is_whole = not forwards.zenoh or {HEAD, machine} <= forwards.zenoh.keys()
    is_whole = is_whole and len(ports) <= _MOST_MACHINES
    if not is_whole or len(set(ports)) < len(ports) or any(one not in PORT_RANGE for one in ports):
        first, last = PORT_RANGE[0], PORT_RANGE[-1]
        message = f"cannot forward the ports to machine {machine}"
        raise bad_input(message, f"links take ports from {first} to {last}, each once")


def _same(port: int) -> str:
    return f"127.0.0.1:{port}:127.0.0.1:{port}"


def _no_link() -> DoraSystemdError:
    hint = "doractl start starts the links of a dataflow"
    return usage_error("cannot read the command line of a link", hint)

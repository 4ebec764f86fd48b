"""`doractl logs` of a dataflow on several machines: merges their logs like those of hosts."""

from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase

import click
from click.core import ParameterSource

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import print_warnings
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.cli.remote.run import pass_through, run_on_all
from dora_systemd.decisions.cell.machines import HEAD, Placed, machine_of
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import did_you_mean
from dora_systemd.scope import Scope, scope_of
from dora_systemd.values import quoted
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.machines import member_hosts
from dora_systemd.verbs.facts.selector import Selector, is_pattern

_OWN = {"selectors", "machine", "output", "no_pager"}
"""Parameters that are not passed on as they are."""


def print_machines(scope: Scope, context: click.Context) -> int | None:
    """Print the logs of all machines of the dataflow that is meant, or of --machine.

    Returns the exit status; None if that are the logs of this machine alone. Raises
    DoraSystemdError: USAGE for a machine that the dataflow does not have.
    """
    found = find_machines(scope, context)
    if found is None:
        return None
    hosts, plan = found
    # Each JSON object contains its machine, also if there is only one.
    output = context.params["output"]
    if len(hosts) > 1 or output == "json":
        return run_on_all(hosts, plan)
    return pass_through(hosts[0], plan._replace(words=[*plan.words, "-o", output]))


def find_machines(scope: Scope, context: click.Context) -> tuple[list[Host], Plan] | None:
    """Find the machines whose logs are requested, and the command; None for this machine alone.

    Raises DoraSystemdError as print_machines().
    """
    given = context.params
    wanted, selectors = given["machine"], given["selectors"]
    if wanted and len(selectors) != 1:
        message = "cannot use --machine without one dataflow"
        raise usage_error(message, "doractl logs NAME --machine MACHINE")
    if wanted == HEAD or is_pattern(selectors[0]):
        return None
    bus = Bus(scope, for_reading=True)
    cell = _running(bus, selectors[0], wanted)
    known = member_hosts(bus, cell.options) if cell else {}
    if cell is None or not known:
        if wanted:
            message = f"cannot find machine {quoted(wanted)}: {selectors[0]} runs on this one only"
            raise usage_error(message, "leave out --machine")
        return None
    if scope != scope_of(None):
        # Only the user of that scope has its keys for ssh.
        if not given["is_quiet"]:
            print_warnings([f"the logs of {', '.join(known)} are left out: use sudo"])
        return None
    names = [wanted] if wanted else _machines_of(cell.options.placed, given["nodes"], known)
    if names == [HEAD]:
        return None
    return [_host_of(one, known, cell.name) for one in names], _plan(cell.name, context)


def _running(bus: Bus, selector: str, wanted: str) -> Cell | None:
    """The dataflow, if systemd has it: an ended one has no links."""
    try:
        return Selector(selector).find(bus)
    except DoraSystemdError as error:
        if wanted and error.code is ExitCode.NOT_FOUND:
            message = f"cannot find machine {quoted(wanted)}: {selector} is not running"
            hint = f"doractl -H HOST logs {selector}, with the host of the machine"
            raise DoraSystemdError(message, hint, error.code) from error
        if wanted:
            raise
        return None


def _machines_of(
    placed: Sequence[Placed], nodes: Sequence[str], known: dict[str, Host | None]
) -> list[str]:
    """The machines of these nodes, which may be patterns; all for none."""
    if not nodes:
        return [HEAD, *known]
    found = {machine_of(placed, node) for node in nodes if not is_pattern(node)}
    for pattern in filter(is_pattern, nodes):
        found |= {HEAD, *(one.machine for one in placed if fnmatchcase(one.node, pattern))}
    return [one for one in (HEAD, *known) if one in found]


def _host_of(name: str, known: dict[str, Host | None], dataflow: str) -> Host:
    if name == HEAD:
        return Host(HEAD, "")
    if name not in known:
        hint = did_you_mean(name, known) or f"valid values: {', '.join((HEAD, *known))}"
        message = f"cannot find machine {quoted(name)}: {dataflow} does not run there"
        raise usage_error(message, hint)
    host = known[name]
    if host is None:
        message = f"cannot reach machine {name}: its link is not loaded"
        raise DoraSystemdError(message, f"doractl restart {dataflow}", ExitCode.NO_HOST)
    return host._replace(text=name)


def _plan(name: str, context: click.Context) -> Plan:
    given = context.params
    words = ["logs", name, *_given_words(context), f"--machine={HEAD}"]
    is_endless = bool(given["is_follow"] or given["until_end"])
    return Plan("logs", words, words, given, False, False, is_endless, "machine")


def _given_words(context: click.Context) -> Iterator[str]:
    """The options of the command line, which mean the same on each machine."""
    for option in context.command.params:
        name = option.name or ""
        is_given = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        is_passed = is_given and name in context.params and name not in _OWN
        if not is_passed or not isinstance(option, click.Option):
            continue
        value, flag = context.params[name], option.opts[-1]
        if option.is_flag:
            yield flag
        else:
            values = value if option.multiple else [value]
            yield from (
                f"{flag}={one}" if flag.startswith("--") else f"{flag}{one}" for one in values
            )

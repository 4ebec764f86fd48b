"""Run the part of a dataflow on this machine, for the head that has started it."""

import os
import sys
from pathlib import Path
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import write_exactly
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.cli.setting_options import SettingsCommand, setting_options
from dora_systemd.decisions.cell.machines import parse_head, parse_machine, parse_placed
from dora_systemd.decisions.machines.address import parse_address
from dora_systemd.decisions.machines.link_command import RESTRICTED
from dora_systemd.decisions.machines.wire import Refused
from dora_systemd.decisions.settings.resolve import SET
from dora_systemd.decisions.settings.table import SETTINGS
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import parse_name, parse_uuid
from dora_systemd.verbs.machines.member import (
    Head,
    MemberRequest,
    become_relay,
    is_passing,
    start_member,
)
from dora_systemd.verbs.machines.push import PLACE, format_place, place_problem
from dora_systemd.verbs.machines.register import ORIGINAL, forced_words
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.version import own_facts

_FORCED = "dora_systemd.member.forced"


class MemberCommand(SettingsCommand):
    """A verb that sshd may run as the forced command of a key, see sshd(8)."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        original = os.environ.get(ORIGINAL, "")
        if not args and original:
            mark, args = forced_words(original)
            ctx.meta[_FORCED] = True
            for stream in (sys.stdout, sys.stderr):
                print(mark, file=stream, flush=True)
        return super().parse_args(ctx, args)


def _require_forced(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    del param
    if value and not ctx.meta.get(_FORCED):
        message = "the key of the machine is not let in, and another one was used"
        hint = "on the head: doractl machine remove --force NAME, then doractl machine add"
        raise DoraSystemdError(message, hint, ExitCode.NO_PERMISSION)


def _print_facts(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    del param
    if value:
        write_exactly(f"{own_facts(current_scope()).to_json()}\n")
        ctx.exit()


def _print_place(ctx: click.Context, param: click.Parameter, value: str | None) -> None:
    del param
    if value is not None:
        way_out = "log in as its user: host: USER@HOST"
        problem, hint = place_problem(Path(value), way_out) or ("", "")
        write_exactly(f"{format_place(problem, hint)}\n")
        ctx.exit()


@click.command("member", cls=MemberCommand, hidden=True)
@click.argument("dataflow", metavar="FILE")
@click.option("--name", required=True, metavar="NAME", help="Name of the dataflow.")
@click.option("--uuid", required=True, metavar="UUID", help="Its UUID.")
@click.option("--as", "machine", required=True, metavar="MACHINE", help="Name of this machine.")
@click.option(
    "--placed",
    multiple=True,
    required=True,
    metavar="NODE=MACHINE",
    help="Where a node runs that does not run on the head.",
)
@click.option("--head", default="", metavar="HOST", help="The host name of the head, for people.")
@click.option(
    "--address",
    multiple=True,
    metavar="ADDRESS",
    help="With link: direct, the address of each machine; that of this one first.",
)
@click.option(
    f"--{SET}",
    multiple=True,
    metavar="[NODE:]KEY=TEXT",
    help="A setting of the head for the runner here; without NODE for all nodes.",
)
@click.option(
    RESTRICTED,
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_require_forced,
    help="Refuse to run unless sshd has forced this command, for the key of machine add.",
)
@click.option(
    "--facts",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_facts,
    help="Only print what a head wants to know of this machine, as JSON.",
)
@click.option(
    PLACE,
    metavar="DIRECTORY",
    is_eager=True,
    expose_value=False,
    callback=_print_place,
    help="Only print whether start --push may write there, as JSON.",
)
@setting_options
@scope_options
def command(
    dataflow: str,
    name: str,
    uuid: str,
    machine: str,
    placed: tuple[str, ...],
    head: str,
    address: tuple[str, ...],
    **flags: Any,
) -> int:
    """Run the nodes of FILE that belong to this machine, as the service dora-NAME.service.

    Only the link of a head calls this, by ssh: it says where the coordinator is, and the nodes end
    when it is gone. See dora-systemd-machines(7).

    Examples:
      doractl member flow.yml --name robot --uuid UUID --as gpu --placed yolo=gpu
    """
    if sys.stdin.isatty():
        hint = "doractl start on the head starts the members"
        raise usage_error("cannot run a member: no head is here", hint)
    start = StartRequest(
        dataflow,
        parse_name(name),
        flags,
        os.environ,
        uuid=parse_uuid(uuid),
        placed=tuple(map(parse_placed, placed)),
        machine=parse_machine(machine),
        head=parse_head(head),
        addresses=tuple(map(parse_address, address)),
    )
    scope = current_scope()
    with Head() as told:
        try:
            runner = start_member(Bus(scope), MemberRequest(scope, start), told)
        except DoraSystemdError as error:
            if not is_passing(error):
                told.tell(Refused(error.message, error.hint))
            raise
    become_relay(runner)


for _one in command.params:
    # The options of start; the head passes on those of its own start.
    if isinstance(_one, click.Option) and _one.name in {one.name for one in SETTINGS}:
        _one.hidden = True

"""Chooses what is different in a cell if its dataflow has several machines."""

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.cell.life import Life
from dora_systemd.runner.cell.role import Alone


def role_of(options: RunnerOptions, this_life: Life, boot: EarlyDaemon | None) -> Alone:
    """What this machine is in the dataflow of `options`. boot: of the first run."""
    if not options.placed:
        return Alone(options, this_life)
    if options.machine:
        from dora_systemd.runner.machines.member import Member

        return Member(options, this_life, boot)
    from dora_systemd.runner.machines.head import Head

    return Head(options, this_life, boot)

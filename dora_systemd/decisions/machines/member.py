"""Divides the settings of a start between the members of a dataflow and the head. Pure.

Settings of a node go to the machine that runs the node. Settings of the whole dataflow go to all
machines, as far as nodes depend on them: variables, the sandbox, the grace duration. Limits and
other properties of the unit apply to the head; an entry of `machines:` has those of its machine.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.options import (
    RunnerOptions,
    SettingText,
    format_setting,
    runner_setting,
)
from dora_systemd.decisions.machines.entry import Machine
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.resolve import SET, Settings
from dora_systemd.decisions.settings.sandbox import SANDBOX
from dora_systemd.decisions.settings.table import (
    ALLOW_SHELL_NODES,
    ENV,
    GRACE_DURATION,
    UV,
    WORKING_DIRECTORY,
)
from dora_systemd.errors import DoraSystemdError, ExitCode

VERB = "member"
_SHARED: tuple[Setting[Any], ...] = (UV, ALLOW_SHELL_NODES, GRACE_DURATION, SANDBOX)
_MOST_BYTES = 100_000
"""Linux takes 128 KiB as one argument, and ssh(1) makes one of the whole command; see execve(2)."""


class Member(NamedTuple):
    """A machine that runs nodes of a dataflow whose head is here."""

    machine: str  # its name
    host: Host  # for ssh(1)
    # the arguments of doractl there, which begin with `member FILE`; nobody but doractl writes
    # them, see dora_systemd.decisions.machines.wire
    words: tuple[str, ...]

    def with_uuid(self, old: str, new: str) -> "Member":
        """Return a copy whose arguments contain the UUID `new` instead of `old`."""
        told = {f"--uuid={old}": f"--uuid={new}"}
        return self._replace(words=tuple(told.get(word, word) for word in self.words))


def on_head(options: RunnerOptions) -> RunnerOptions:
    """Return the options of the head's runner, without those that only members need."""
    away = {one.node for one in options.placed}
    return options._replace(
        head="",
        settings=tuple(
            one
            for one in options.settings
            if one.node not in away or runner_setting(one.key).on_head
        ),
    )


def member_of(
    machine: Machine,
    options: RunnerOptions,
    settings: Settings,
    variables: Mapping[str, str],
) -> Member:
    """Return the Member for a machine. Raises DoraSystemdError (BAD_INPUT) for too long settings.

    options: before on_head(), with the name of the head. variables: of --env and of the
    environment files here.
    """
    words = tuple(_words(machine, options, settings, variables))
    if sum(len(word.encode()) + 4 for word in words) > _MOST_BYTES:
        raise DoraSystemdError(
            f"cannot start {options.name}: its settings are too long for machine {machine.name}",
            "write them into the settings file on that machine",
            ExitCode.BAD_INPUT,
        )
    return Member(machine.name, machine.host, words)


def _words(
    machine: Machine,
    options: RunnerOptions,
    settings: Settings,
    variables: Mapping[str, str],
) -> Iterator[str]:
    here = PurePath(options.dataflow)
    yield from (VERB, str(PurePath(machine.directory or here.parent, here.name)))
    yield f"--name={options.name}"
    yield f"--uuid={options.uuid}"
    yield from [f"--head={options.head}"] if options.head else []
    yield from (f"--placed={'='.join(one)}" for one in options.placed)
    yield from (f"--address={one}" for one in _own_first(options.addresses, machine.address))
    nodes = [one.node for one in options.placed if one.machine == machine.name]
    yield from (f"--{SET}={format_setting(one)}" for one in _passed_on(options.settings, nodes))
    given = [(one, settings[one]) for one in _SHARED if settings.is_given(one)]
    if settings[WORKING_DIRECTORY] is not None:
        given.append((WORKING_DIRECTORY, _directory(machine, options)))
    own = {one.name: (one, value) for one, value in machine.settings}
    _, env = own.pop(ENV.name, (ENV, {}))
    given.append((ENV, {**variables, **env}))
    kept = {one.name: (one, value) for one, value in given}
    for setting, value in {**kept, **own}.values():
        yield from _flags(setting, value)


def _passed_on(settings: Sequence[SettingText], nodes: Sequence[str]) -> Iterator[SettingText]:
    """The settings of `nodes`, and those for all nodes."""
    for one in settings:
        setting = runner_setting(one.key)
        is_for_them = one.node in nodes or (not one.node and setting.per_node)
        if is_for_them and setting.on_members:
            yield one


def _own_first(addresses: Sequence[str], own: str) -> list[str]:
    return sorted(addresses, key=lambda one: one != own)


def _flags(setting: Setting[Any], value: Any) -> Iterator[str]:
    flag = setting.flags[0]
    if setting.kind.is_flag:
        yield flag if value else flag.replace("--", "--no-", 1)
    else:
        yield from (f"{flag}={text}" for text in setting.kind.format(value))


def _directory(machine: Machine, options: RunnerOptions) -> str:
    """Return the working directory on the machine: below the dataflow file's, if it is so here."""
    there, here = PurePath(options.working_directory), PurePath(options.dataflow).parent
    if machine.directory and there.is_relative_to(here):
        return str(PurePath(machine.directory, there.relative_to(here)))
    return str(there)

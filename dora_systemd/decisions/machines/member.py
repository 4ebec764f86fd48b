"""Machines of a dataflow: the entries of `machines:`, and which settings of a start go where. Pure.

    gpu: {host: alice@gpu-box, directory: /home/alice/robot, venv: /opt/vision, memory_limit: 8G}

Paths in an entry are paths on that machine; relative ones start in the entry's directory. In a
config.yml, lines of an entry are added and removed without a YAML library, so that all others stay
as they are. The caller reads the result again, and compares: YAML has more forms than these.

Settings of a node go to the machine that runs the node. Settings of the whole dataflow go to all
machines, as far as nodes depend on them: variables, the sandbox, the grace duration. Limits and
other properties of the unit apply to the head; an entry of `machines:` has those of its machine.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.options import (
    RunnerOptions,
    SettingText,
    format_setting,
    runner_setting,
)
from dora_systemd.decisions.machines.address import parse_address
from dora_systemd.decisions.remote.hosts import Host, parse_host
from dora_systemd.decisions.settings.kinds import Scalar, Setting, one_text
from dora_systemd.decisions.settings.limits import LIMIT_SETTINGS
from dora_systemd.decisions.settings.machines import HOST, Declared
from dora_systemd.decisions.settings.resolve import SET, Settings, check_document
from dora_systemd.decisions.settings.sandbox import CREDENTIAL_SETTINGS, SANDBOX, WRITABLE
from dora_systemd.decisions.settings.table import (
    ALLOW_SHELL_NODES,
    DORA,
    ENV,
    ENV_FILE,
    GRACE_DURATION,
    PROPERTY,
    USER,
    UV,
    VENV,
    WORKING_DIRECTORY,
)
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.values import quoted, scalar_text, shown

DIRECT = "direct"
LINKS = ("ssh", DIRECT)
ADDRESS, HEAD_ADDRESS = "address", "head_address"
_TEXT = one_text(Scalar, "a text", "TEXT", str)
_LABELS = one_text(dict[str, Scalar], "a mapping, LABEL: VALUE", "", str)
_OWN = (
    Setting[str](HOST, _TEXT, "", ""),
    Setting[str]("directory", _TEXT, "", ""),
    Setting[str]("link", _TEXT, "", ""),
    Setting[str](ADDRESS, _TEXT, "", ""),
    Setting[str](HEAD_ADDRESS, _TEXT, "", ""),
    Setting[str]("labels", _LABELS, "", ""),
)
_UNIT: tuple[Setting[Any], ...] = (
    *(ENV, ENV_FILE, VENV, PROPERTY, USER, DORA),
    *(one for one in LIMIT_SETTINGS if one.flags),
    *CREDENTIAL_SETTINGS,
    *(SANDBOX, WRITABLE),
)
OF_MACHINES = tuple(replace(one, per_node=False) for one in _UNIT)
"""The settings of a unit that each machine may override."""


class Machine(NamedTuple):
    """A declared machine."""

    name: str
    host: Host
    directory: str  # of the dataflow file on that machine, absolute; "" for the same as on the head
    labels: Mapping[str, str]
    settings: Sequence[tuple[Setting[Any], Any]]  # with their values
    is_own: bool  # it is declared for this dataflow, and not for all in a config.yml
    link: str = LINKS[0]  # one of LINKS
    # address, head_address: of the machine and of the head; "" if not given
    address: str = ""
    head_address: str = ""


def parse_entry(name: str, declared: Declared, source: str, dataflow: str) -> Machine:
    """The machine that is declared so.

    source: the flags and files that declare machines. dataflow: its file here. Raises
    DoraSystemdError (BAD_INPUT) that names source and key.
    """
    where = f"machines.{name} in {shown(source)}"
    values = _checked(where, declared.values)
    here = PurePath(dataflow).parent
    directory = _directory_there(values.get("directory"), where)
    link = _link(values, where)
    labels = values.get("labels", {})
    return Machine(
        name,
        _host(values.get(HOST, name), where),
        directory,
        {key: scalar_text(value) for key, value in labels.items()},
        tuple(_settings(values, PurePath(directory or here), where)),
        any(base in (None, here) for base in declared.bases),
        link,
        *(_address(values.get(key), key, where) for key in (ADDRESS, HEAD_ADDRESS)),
    )


def _checked(where: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
    if values.keys() == {HOST} and isinstance(values[HOST], str):
        return values  # as --machine: to import pydantic takes a fifth of a start
    return check_document(where, values, (*_OWN, *OF_MACHINES))


def _settings(
    values: Mapping[str, Any], base: PurePath, where: str
) -> Iterator[tuple[Setting[Any], Any]]:
    for setting in OF_MACHINES:
        if setting.name in values:
            try:
                yield setting, setting.kind.parse(values[setting.name], base)
            except DoraSystemdError as error:
                raise bad_input(
                    f"{setting.name} of {where}: {error.message}", error.hint
                ) from error


def _host(value: Any, where: str) -> Host:
    try:
        return parse_host(scalar_text(value))
    except DoraSystemdError as error:
        raise bad_input(
            f"{HOST} of {where}: {error.message}", "write [user@]HOST[:PORT]"
        ) from error


def _directory_there(value: Any, where: str) -> str:
    text = scalar_text(value) if value is not None else ""
    if text and not (text.startswith("/") and text.isprintable() and ".." not in text.split("/")):
        hint = "write an absolute path of that machine without '..'"
        raise bad_input(f"directory of {where}: cannot use {quoted(text)}", hint)
    return str(PurePath(text)) if text else ""


def _link(values: Mapping[str, Any], where: str) -> str:
    link = scalar_text(values.get("link", LINKS[0]))
    if link not in LINKS:
        hint = f"valid values: {', '.join(LINKS)}"
        raise bad_input(f"link of {where}: cannot use {quoted(link)}", hint)
    if link == DIRECT and ADDRESS not in values:
        hint = "write address: and the IP address on which the machine listens for the others"
        raise bad_input(f"{where}: link: {DIRECT} needs an address", hint)
    for key in (ADDRESS, HEAD_ADDRESS):
        if link != DIRECT and key in values:
            hint = f"write link: {DIRECT}, or leave {key} out"
            raise bad_input(f"{where}: {key} is for link: {DIRECT} only", hint)
    return link


def _address(value: Any, key: str, where: str) -> str:
    try:
        return "" if value is None else parse_address(scalar_text(value))
    except DoraSystemdError as error:
        raise bad_input(f"{key} of {where}: {error.message}", error.hint) from error


_KEY = re.compile(r"^machines:[ \t]*(?:#.*)?$", re.MULTILINE)
_ANY = re.compile(r"^machines[ \t]*:", re.MULTILINE)


def with_machine(text: str, name: str, host: str) -> str | None:
    """The text with one more machine; None if `machines:` has a form that is not for lines."""
    entry = f'  {name}: {{host: "{host}"}}\n'  # no host has a quote
    found = _KEY.search(text)
    if found:
        end = found.end() + 1
        head = text[:end] if text[:end].endswith("\n") else f"{text[:end]}\n"
        return head + _indented(text[end:], entry) + text[end:]
    if _ANY.search(text):
        return None
    joined = text if not text or text.endswith("\n") else f"{text}\n"
    return f"{joined}machines:\n{entry}"


def without_machine(text: str, name: str) -> str | None:
    """Return the text without the machine; None if the entry shares a line with other text."""
    pattern = rf"^(?P<in>[ ]+)(?P<q>[\"']?){re.escape(name)}(?P=q):.*\n?(?:(?P=in)[ ]+.*\n?)*"
    found = re.search(pattern, text, re.MULTILINE)
    heading = _KEY.search(text)
    if not found or not heading or found.start() < heading.end():
        return None
    left = text[: found.start()] + text[found.end() :]
    after = left[heading.end() :].lstrip("\n")
    is_last = not after.startswith((" ", "\t", "#"))
    return left[: heading.start()] + after if is_last else left


def _indented(after: str, entry: str) -> str:
    """Indent the entry like the existing entries."""
    first = re.match(r"([ ]+)\S", after)
    return f"{first[1] if first else '  '}{entry.lstrip()}"


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
    machine: Machine, options: RunnerOptions, settings: Settings, variables: Mapping[str, str]
) -> Member:
    """Return the Member for a machine. Raises DoraSystemdError (BAD_INPUT) for too long settings.

    options: before on_head(), with the name of the head. variables: of --env and of the
    environment files here.
    """
    words = tuple(_words(machine, options, settings, variables))
    if sum(len(word.encode()) + 4 for word in words) > _MOST_BYTES:
        raise bad_input(
            f"cannot start {options.name}: its settings are too long for machine {machine.name}",
            "write them into the settings file on that machine",
        )
    return Member(machine.name, machine.host, words)


def _words(
    machine: Machine, options: RunnerOptions, settings: Settings, variables: Mapping[str, str]
) -> Iterator[str]:
    here = PurePath(options.dataflow)
    yield from (VERB, str(PurePath(machine.directory or here.parent, here.name)))
    yield f"--name={options.name}"
    yield f"--uuid={options.uuid}"
    yield from [f"--head={options.head}"] if options.head else []
    yield from (f"--placed={'='.join(one)}" for one in options.placed)
    own_first = sorted(options.addresses, key=lambda one: one != machine.address)
    yield from (f"--address={one}" for one in own_first)
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

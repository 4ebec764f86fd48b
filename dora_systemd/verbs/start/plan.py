"""Makes the plan of a start: reads and checks everything before systemd gets a request.

What dora and the nodes' programs would report is checked in the cell, see adapters/dora/check.py.
"""

import os
import pwd
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from dora_systemd.adapters.dora.preparation import Prepared, check_named_nodes
from dora_systemd.adapters.host.files import decoded, parse_yaml, read_text
from dora_systemd.decisions.cell.environment import unit_environment
from dora_systemd.decisions.cell.environment_file import parse_environment_file
from dora_systemd.decisions.cell.launch import LaunchPlan, launch_descriptor
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.decisions.descriptor.expansion import called_variables
from dora_systemd.decisions.descriptor.nodes import UNEXPANDED
from dora_systemd.decisions.properties.sandbox import Sandbox
from dora_systemd.decisions.settings.machines import MACHINES
from dora_systemd.decisions.settings.resolve import Settings, with_settings
from dora_systemd.decisions.settings.table import ENV, ENV_FILE, USER, WORKING_DIRECTORY
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import name_from_path, parse_name, release_of, unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.files import Text, read_file
from dora_systemd.trust.paths import Place, exists
from dora_systemd.trust.sight import sight_of
from dora_systemd.values import shown
from dora_systemd.verbs.start.account import account_of, choose_user
from dora_systemd.verbs.start.find_files import (
    Look,
    check_credentials,
    credential_files,
    plan_notes,
)
from dora_systemd.verbs.start.sandbox import make_sandbox
from dora_systemd.verbs.start.settings import read_settings

if TYPE_CHECKING:  # most dataflows run on one machine
    from dora_systemd.decisions.machines.member import Member

DEFAULT_FILE = "dataflow.yml"


@dataclass(frozen=True)
class StartRequest:
    """A request to start a dataflow. flags: raw values by setting name, see resolve_settings.

    environment: the caller's variables. attached: the dataflow ends with the caller. caller: the
    variables that the dataflow may read. uuid: of a dataflow that is started again. origin: of a
    release, the file that its dataflow file was copied from: who owns that decides, not root, who
    owns the copy. is_unbuilt: a build may make the programs of its nodes, see Plan.missing.
    machine, head, placed, addresses: of the runner's options, if this machine is a member of the
    dataflow.
    """

    dataflow: str
    name: str | None = None
    flags: Mapping[str, object] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    attached: bool = False
    caller: Mapping[str, str] = field(default_factory=dict)
    uuid: str = ""
    origin: Place | None = None
    is_unbuilt: bool = False
    machine: str = ""
    head: str = ""
    placed: tuple[Placed, ...] = ()
    addresses: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """A checked request.

    user: for User=, None in user scope. environment: all of Environment=. notes: for people, once
    it has started. members: the other machines, if it runs on several.
    """

    scope: Scope
    options: RunnerOptions
    settings: Settings
    user: pwd.struct_passwd | None
    environment: Mapping[str, str]
    sandbox: Sandbox = field(default_factory=Sandbox)
    notes: tuple[str, ...] = ()
    members: tuple["Member", ...] = ()
    missing: DoraSystemdError | None = None

    @property
    def unit(self) -> str:
        """The name of the unit."""
        return unit_name(self.options.name)


def request_name(request: StartRequest) -> str:
    """The name of the dataflow. Raises DoraSystemdError (USAGE)."""
    if request.name is not None:
        return parse_name(request.name)
    return name_from_path(str(path_of(request)))


def path_of(request: StartRequest) -> Path:
    """The absolute path that was asked for. Raises DoraSystemdError (BAD_INPUT) if it is empty."""
    if not request.dataflow:  # not the working directory: a variable of a script is not set
        raise DoraSystemdError("cannot read '': no path", "name a file", ExitCode.BAD_INPUT)
    try:
        return Path(request.dataflow).absolute()
    except FileNotFoundError as error:
        message = f"cannot read {shown(request.dataflow)}: the current directory was removed"
        hint = "cd to a directory that exists"
        raise DoraSystemdError(message, hint, ExitCode.BAD_INPUT) from error


def _read(path: Path) -> Text:
    """The dataflow file. Raises DoraSystemdError (BAD_INPUT)."""
    try:
        return read_file(path)
    except DoraSystemdError as error:
        if path.name != DEFAULT_FILE or exists(path):
            raise
        # Perhaps nobody has named it.
        hint = "go to the directory of a dataflow, or name its file"
        raise DoraSystemdError(error.message, hint, error.code) from error


def make_plan(scope: Scope, request: StartRequest) -> Plan:
    """Read and check everything that does not need dora; changes nothing.

    Raises DoraSystemdError.
    """
    path = path_of(request)
    request_name(request)
    written = _read(path)
    if request.origin is None:
        _refuse_release(path)
    place = request.origin or written.place
    settings = read_settings(scope, path, request.flags, request.environment, request.origin)
    given = settings[WORKING_DIRECTORY]
    directory = path.parent if given is None else Path(given).absolute()
    user = choose_user(scope, settings[USER], place, str(directory))
    with sight_of(account_of(user)) as sight:
        # The process that looks for another user boots meanwhile.
        dataflow = parse_dataflow(parse_yaml(decoded(written.data, path), path), str(path))
        look = Look(sight, settings, user)
        # Root's variables are not for the file of another user, which could read them out.
        is_own = scope.is_user or place.uid == os.geteuid()
        caller = request.environment if is_own else {}
        return _make_plan(scope, replace(request, caller=caller), dataflow, str(directory), look)


def _refuse_release(path: Path) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a file of a release.

    It is root's, and what it says is not: root must not take settings from it as from its own.
    """
    if release := release_of(str(path)):
        hint = f"doractl rollback NAME {release} runs that release"
        message = f"cannot start {path}: it belongs to a release"
        raise DoraSystemdError(message, hint, ExitCode.BAD_INPUT)


def _make_plan(
    scope: Scope, request: StartRequest, dataflow: Dataflow, directory: str, look: Look
) -> Plan:
    settings, path = look.settings, dataflow.source
    venv = look.find_venv(path, request.environment)
    search_path = request.environment.get("PATH") or os.defpath
    variables = _variables(settings, look)
    look.check_reach(path, directory)
    options = RunnerOptions(
        name=request_name(request),
        uuid=request.uuid or str(uuid.uuid4()),
        dataflow=path,
        working_directory=directory,
        dora=look.find_dora(venv, search_path),
        venv=venv,
        attached=request.attached,
        env_keys=tuple(variables),
        placed=request.placed,
        machine=request.machine,
        head=request.head,
        addresses=request.addresses,
    )
    options = with_settings(options, settings)
    if options.hot_reload:
        # Imported late: few dataflows have it, and asyncio is slow to import.
        from dora_systemd.adapters.host.watch import require_watcher

        require_watcher()
    options, members = _spread(dataflow, options, settings, variables)
    called = called_variables(dataflow, request.caller)
    environment = unit_environment(search_path, venv, {**called, **variables})
    check_credentials(scope, credential_files(settings))
    sight, session = look.sight, look.read_session(path)
    launch = LaunchPlan(options, "", environment["PATH"], sight.exists, sight.read, session)
    missing = None
    if not any(node.kind in UNEXPANDED for node in dataflow.nodes):
        # The runner repeats this, but an error here needs no unit.
        check_named_nodes(options, dataflow)
        missing = _find_missing(dataflow, launch, request.is_unbuilt)
    prepared = Prepared(dataflow, launch, {})
    sandbox = make_sandbox(scope, settings, look.user, prepared, look.sight)
    notes = tuple(plan_notes(scope, dataflow, launch, look))
    return Plan(scope, options, settings, look.user, environment, sandbox, notes, members, missing)


def _find_missing(
    dataflow: Dataflow, launch: LaunchPlan, is_unbuilt: bool
) -> DoraSystemdError | None:
    """Check the programs of the nodes; return the error if a build may make a missing one."""
    try:
        launch_descriptor(dataflow, launch)
    except DoraSystemdError as error:
        if not is_unbuilt:
            raise
        return error
    return None


def _spread(
    dataflow: Dataflow, options: RunnerOptions, settings: Settings, variables: Mapping[str, str]
) -> "tuple[RunnerOptions, tuple[Member, ...]]":
    """The options of the runner here, and what other machines are told."""
    is_spread = settings[MACHINES] or any("deploy" in node.raw for node in dataflow.nodes)
    if not (options.machine or is_spread):
        return options, ()
    # Imported late: most dataflows run on one machine.
    from dora_systemd.decisions.machines.spread import part, spread

    if options.machine:
        return part(options, settings), ()
    from dora_systemd.adapters.host.addresses import source_address

    return spread(dataflow, options, settings, variables, os.uname().nodename, source_address)


def _variables(settings: Settings, look: Look) -> dict[str, str]:
    """The variables of --env and --env-file; --env has precedence, then the last file."""
    variables: dict[str, str] = {}
    for file in settings[ENV_FILE]:
        text = look.read_lent(file) if file in settings.lent else read_text(Path(file))
        variables |= parse_environment_file(text, file)
    given = settings[ENV]
    return {**variables, **given}

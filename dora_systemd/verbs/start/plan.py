"""Makes the plan of a start: reads and checks everything before systemd gets a request.

What dora and the nodes' programs would report is checked in the cell, see adapters/dora/check.py.
"""

import pwd
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.properties.sandbox import Sandbox
from dora_systemd.decisions.settings.resolve import Settings, require_effect
from dora_systemd.decisions.settings.table import USER
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.sight import sight_of
from dora_systemd.verbs.start.read import Files, read_files
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.sandbox import make_sandbox
from dora_systemd.verbs.start.settings import settings_of
from dora_systemd.verbs.start.startable import (
    check_credentials,
    check_startable,
    credential_files,
    plan_notes,
    start_warnings,
)
from dora_systemd.verbs.start.where import (
    Look,
    account_of,
    choose_user,
    find_where,
    working_directory,
)

if TYPE_CHECKING:  # most dataflows run on one machine
    from dora_systemd.decisions.machines.member import Member


class Plan(NamedTuple):
    """A checked request."""

    scope: Scope
    options: RunnerOptions
    settings: Settings
    user: pwd.struct_passwd | None  # for User=, None in user scope
    environment: Mapping[str, str]  # all of Environment=
    sandbox: Sandbox = Sandbox()
    warnings: tuple[str, ...] = ()  # printed before the start
    notes: tuple[str, ...] = ()  # printed after the start
    members: tuple["Member", ...] = ()  # the other machines, if it runs on several
    missing: DoraSystemdError | None = None  # why it cannot start before a build

    @property
    def unit(self) -> str:
        return unit_name(self.options.name)


def make_plan(scope: Scope, request: StartRequest, read: Files | None = None) -> Plan:
    """Read and check everything that does not need dora; changes nothing.

    read: the files of the request, if they have been read. Raises DoraSystemdError.
    """
    files = read or read_files(request)
    settings = settings_of(scope, files, request)
    require_effect(settings, request.changed if request.uuid else request.flags)
    directory = working_directory(files, settings)
    user = choose_user(scope, settings[USER], files.place, directory, settings.source(USER))
    with sight_of(account_of(user)) as sight:
        dataflow = files.dataflow()  # the child that checks paths as another user boots meanwhile
        look = Look(sight, settings, user, directory)
        where = find_where(scope, request, files, dataflow, look)
        check_credentials(scope, credential_files(settings))
        launch, missing = check_startable(where, sight, dataflow, request.is_unbuilt)
        warnings = () if request.is_unbuilt else tuple(start_warnings(where, dataflow, sight))
        unused = look.note_unused_venv(request.environment)
        notes = (*plan_notes(scope, look, dataflow, launch), *([unused] if unused else []))
        sandbox = make_sandbox(scope, look, dataflow, launch)
    facts = (scope, where.options, settings, user, where.environment)
    return Plan(*facts, sandbox, warnings, notes, where.members, missing)

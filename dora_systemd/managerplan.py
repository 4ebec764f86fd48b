"""What `doractl start` is going to do, found out and checked before systemd hears of it."""

import os
import pwd
import sys
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from dora_systemd.dataflow import parse_dataflow
from dora_systemd.environment import parse_environment_file, unit_environment
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.files import read_text, read_yaml
from dora_systemd.limitchecks import settings_node_limits
from dora_systemd.lograteplan import check_rates, log_rates
from dora_systemd.manageraccount import account_of, check_access, choose_user
from dora_systemd.managercredentials import check_credentials, credential_files
from dora_systemd.managersandbox import make_sandbox
from dora_systemd.managersettings import read_settings
from dora_systemd.names import name_from_path, parse_name, unit_name
from dora_systemd.options import RunnerOptions
from dora_systemd.preparation import Prepared, prepare, refusal_of_dora
from dora_systemd.process import Account, Beside, dora_version, find_dora
from dora_systemd.reloadplan import check_reload_nodes, hot_reload
from dora_systemd.restartplan import node_policies, restart_policy
from dora_systemd.restartsettings import START_TIMEOUT
from dora_systemd.sandbox import Sandbox
from dora_systemd.scope import Scope
from dora_systemd.settings import Settings
from dora_systemd.settingtable import (
    ALLOW_SHELL_NODES,
    DEBUG,
    DORA,
    ENV,
    ENV_FILE,
    EXIT_WHEN_NODES_FINISH,
    GRACE_DURATION,
    USER,
    UV,
    VENV,
    WORKING_DIRECTORY,
)

DEFAULT_FILE = "dataflow.yml"


@dataclass(frozen=True)
class StartRequest:
    """What was asked for. flags: raw values by setting name, see resolve_settings.

    environment: the caller's variables. attached: the dataflow ends with the caller.
    """

    dataflow: str
    name: str | None = None
    flags: Mapping[str, object] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    attached: bool = False


@dataclass(frozen=True)
class Plan:
    """A checked request.

    user: for User=, None in user scope. environment: all of Environment=.
    """

    scope: Scope
    options: RunnerOptions
    settings: Settings
    user: pwd.struct_passwd | None
    environment: Mapping[str, str]
    sandbox: Sandbox = field(default_factory=Sandbox)

    @property
    def unit(self) -> str:
        """The unit's name."""
        return unit_name(self.options.name)


def request_name(request: StartRequest) -> str:
    """The name that the dataflow gets. Raises DoraSystemdError (USAGE)."""
    if request.name is not None:
        return parse_name(request.name)
    return name_from_path(str(Path(request.dataflow).absolute()))


def make_plan(scope: Scope, request: StartRequest) -> Plan:
    """Read and check everything; nothing is changed anywhere. Raises DoraSystemdError."""
    name = request_name(request)
    path = Path(request.dataflow).absolute()
    parse_dataflow(read_yaml(path), str(path))  # the plainest mistakes before all others
    settings = read_settings(scope, path, request.flags, request.environment)
    user = choose_user(scope, settings[USER], path)
    venv = _find_venv(settings, path, request.environment)
    search_path = request.environment.get("PATH") or os.defpath
    variables = _variables(settings)
    directory = _directory(settings, path)
    options = RunnerOptions(
        name=name,
        uuid=str(uuid.uuid4()),
        dataflow=str(path),
        working_directory=directory,
        dora=find_dora(_given_dora(settings), venv, search_path),
        venv=venv,
        uv=settings[UV],
        debug=settings[DEBUG],
        allow_shell_nodes=settings[ALLOW_SHELL_NODES],
        grace=settings[GRACE_DURATION],
        attached=request.attached,
        exit_when_nodes_finish=settings[EXIT_WHEN_NODES_FINISH],
        env_keys=tuple(variables),
        log_rates=log_rates(settings),
        node_limits=settings_node_limits(settings),
        restart=restart_policy(settings),
        node_restarts=node_policies(settings),
        start_timeout=settings[START_TIMEOUT],
        reload=hot_reload(settings, directory),
    )
    environment = unit_environment(search_path, venv, variables)
    plan = Plan(scope, options, settings, user, environment)
    sandbox = make_sandbox(scope, settings, user, _check_plan(plan))
    return replace(plan, sandbox=sandbox)


def find_engine(
    scope: Scope, path: Path, environment: Mapping[str, str]
) -> tuple[str, Account | None]:
    """The dora command that would run the dataflow at `path`, and as whom.

    Raises DoraSystemdError.
    """
    settings = read_settings(scope, path, {}, environment)
    venv = _find_venv(settings, path, environment)
    search_path = environment.get("PATH") or os.defpath
    account = account_of(choose_user(scope, settings[USER], path))
    return find_dora(_given_dora(settings), venv, search_path), account


def _check_plan(plan: Plan) -> Prepared:
    """Three programs are asked, and take longer than all else here: so all at the same time.

    Whose answer comes first in the code is whose refusal counts.
    """
    options, account = plan.options, account_of(plan.user)
    places = [options.working_directory, options.dora, sys.executable]
    access = Beside(lambda: check_access(plan.user, [options.dataflow, __file__], places))
    version = Beside(lambda: dora_version(options.dora, account))
    refusal = Beside(lambda: refusal_of_dora(options, plan.environment, account))
    preparation = Beside(lambda: prepare(options, plan.environment))
    access.result()
    check_credentials(plan.scope, credential_files(plan.settings))
    version.result()
    if reason := refusal.result():
        raise DoraSystemdError(
            f"cannot use {options.dataflow}: {reason}",
            f"see {options.dora} validate {options.dataflow}",
            ExitCode.BAD_INPUT,
        )
    # dora validate accepts paths that are not there, and other things that no node can run with.
    prepared = preparation.result()
    ids = [node.id for node in prepared.dataflow.nodes]
    check_rates(options.log_rates, ids)
    check_reload_nodes(options.reload, ids)
    return prepared


def _directory(settings: Settings, dataflow: Path) -> str:
    given = settings[WORKING_DIRECTORY]
    directory = dataflow.parent if given is None else Path(given).absolute()
    if not directory.is_dir():
        raise DoraSystemdError(
            f"cannot use {directory} as working directory: it is no directory",
            "correct --working-directory",
            ExitCode.BAD_INPUT,
        )
    return str(directory)


def _given_dora(settings: Settings) -> str | None:
    return None if settings.source(DORA) == "default" else settings[DORA]


def _find_venv(settings: Settings, dataflow: Path, environment: Mapping[str, str]) -> str | None:
    """--venv, else the caller's VIRTUAL_ENV, else .venv beside the dataflow, else none."""
    given = settings[VENV]
    if given is not None:
        return _checked_venv(Path(given).absolute())
    places = [environment.get("VIRTUAL_ENV", ""), str(dataflow.parent / ".venv")]
    return next((one for one in places if one.startswith("/") and _is_venv(Path(one))), None)


def _checked_venv(venv: Path) -> str:
    if not _is_venv(venv):
        raise DoraSystemdError(
            f"cannot use {venv} as virtual environment: it has no bin/python",
            f"python3 -m venv {venv}",
            ExitCode.BAD_INPUT,
        )
    return str(venv)


def _is_venv(venv: Path) -> bool:
    return (venv / "bin" / "python").exists()


def _variables(settings: Settings) -> dict[str, str]:
    """What --env and --env-file set; --env wins, and a later file."""
    variables: dict[str, str] = {}
    for file in settings[ENV_FILE]:
        variables |= parse_environment_file(read_text(Path(file)), file)
    given = settings[ENV]
    return {**variables, **given}

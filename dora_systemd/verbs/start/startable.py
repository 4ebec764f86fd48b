"""Checks whether a dataflow could start: its nodes, their programs, its credentials."""

import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path

from dora_systemd.adapters.dora.preparation import check_named_nodes
from dora_systemd.adapters.host.files import absolute_path, decoded, parse_yaml
from dora_systemd.decisions.cell.launch import LaunchPlan, idle_budgets, launch_descriptor
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.uv import LOCK, find_lock, uv_project
from dora_systemd.decisions.descriptor.dataflow import (
    BuildSession,
    Dataflow,
    parse_session,
    session_path,
)
from dora_systemd.decisions.descriptor.nodes import UNEXPANDED, NodeKind
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.sandbox import CREDENTIALS, MOST_OF_CREDENTIALS, NETWORK
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import reached
from dora_systemd.trust.sight import Sight
from dora_systemd.values import shell_word, shown
from dora_systemd.verbs.start.programs import version_trouble
from dora_systemd.verbs.start.where import Look, Where


def check_startable(
    where: Where, sight: Sight, dataflow: Dataflow, is_unbuilt: bool
) -> tuple[LaunchPlan, DoraSystemdError | None]:
    """Check how the nodes would be launched, and what is missing that a build may still create.

    Raises DoraSystemdError for what the runner would refuse, as far as that needs no dora.
    """
    options, path = where.options, where.environment["PATH"]
    session = _read_session(dataflow.source, sight)
    launch = LaunchPlan(options, "", path, sight.exists, sight.read, session)
    if any(node.kind in UNEXPANDED for node in dataflow.nodes):
        return launch, None
    check_named_nodes(options, dataflow)
    try:
        launch_descriptor(dataflow, launch)
    except DoraSystemdError as error:
        if not is_unbuilt:
            raise
        return launch, error
    return launch, None


def _read_session(dataflow: str, sight: Sight) -> BuildSession:
    """The session that `dora build` has saved, if any. Raises DoraSystemdError."""
    path = Path(session_path(dataflow))
    try:
        text = decoded(sight.read(str(path)), path)
    except OSError:
        return BuildSession()
    return parse_session(parse_yaml(text, path, allow_empty=True))


def plan_notes(scope: Scope, look: Look, dataflow: Dataflow, launch: LaunchPlan) -> Iterator[str]:
    """A line for each thing to know or to do."""
    dynamic = [node.id for node in dataflow.nodes if node.kind is NodeKind.DYNAMIC]
    # No other process can reach the ports of a private network.
    if dynamic and look.settings[NETWORK] != "private":
        nodes = f"node{'s' if len(dynamic) > 1 else ''} {', '.join(dynamic)}"
        variables = f'eval "$(doractl {scope.flag} env {launch.options.name})"'
        yield f"start the dynamic {nodes} in another terminal, after: {variables}"
    path = shown(dataflow.source)
    build = f"doractl build {'--uv ' if launch.options.uv else ''}{shell_word(dataflow.source)}"
    if not any(one.build or one.git for one in dataflow.nodes):
        return
    # `dora run` always builds first.
    if not launch.session.directories:
        yield f"no build of {path} is found; to build it: {build}"
    elif _is_build_old(dataflow, look.sight):
        yield f"{path} is newer than its last build; to build again: {build}"


def start_warnings(where: Where, dataflow: Dataflow, sight: Sight) -> Iterator[str]:
    """Warn of what keeps nodes from working. Raises DoraSystemdError for what must."""
    yield from idle_budgets(dataflow, where.options)
    yield from unbuilt_warnings(where.options, sight)
    if any(node.kind in (NodeKind.PYTHON, NodeKind.OPERATOR) for node in dataflow.nodes):
        venv = _nodes_venv(where.options, sight)
        text, remedy = version_trouble(venv, where.options.dora, sight)
        if text:
            yield f"{text}: {remedy}"


def _nodes_venv(options: RunnerOptions, sight: Sight) -> str | None:
    """The virtual environment of Python nodes; `uv run` takes that of its project."""
    project = uv_project(options.working_directory, sight.read) if options.uv else None
    return f"{project}/.venv" if project else options.venv


def unbuilt_warnings(options: RunnerOptions, sight: Sight) -> Iterator[str]:
    """Warn of a project that uv has not built yet: its nodes would run without its packages."""
    places = dict.fromkeys((str(Path(options.dataflow).parent), options.working_directory))
    locked = find_lock(places, sight.exists)
    if locked and options.venv is None and not options.uv:  # else uv makes it
        build = f"doractl build {shell_word(options.dataflow)}"
        yield f"{shown(locked)} has {LOCK} and the nodes have no .venv; to make it: {build}"


def _is_build_old(dataflow: Dataflow, sight: Sight) -> bool:
    """Whether the dataflow has changed since `dora build`."""
    session = str(session_path(dataflow.source))
    return sight.modified_ns(dataflow.source) > sight.modified_ns(session)


def credential_files(settings: Settings) -> dict[str, str]:
    """The absolute path of each credential by its name."""
    return {name: absolute_path(file) for name, file in settings[CREDENTIALS].items()}


def check_credentials(scope: Scope, files: Mapping[str, str]) -> None:
    """Raise DoraSystemdError for a file that systemd could not read, or if all are too large.

    In system scope root reads the files, so one that only the caller cannot read is fine. systemd
    reads them at every start, and follows the path each time: if others could replace a part of the
    path by a link, nodes would get any file that root can read. So only root may be able to.
    """
    total = 0
    for name, file in files.items():
        try:
            total += _checked_size(name, file)
            if not scope.is_user:
                _check_firm(name, file)
        except PermissionError as error:
            if scope.is_callers:
                reason, hint = "permission denied", "let the calling user read it"
                raise _refusal(name, file, reason, hint, ExitCode.NO_PERMISSION) from error
        except OSError as error:
            reason, hint = "there is no such file", "give the path of a file that has the secret"
            raise _refusal(name, file, reason, hint) from error
        if total > MOST_OF_CREDENTIALS:
            reason, hint = "it is too large", "all credentials together have at most 1 MiB"
            raise _refusal(name, file, reason, hint)


def _checked_size(name: str, file: str) -> int:
    status = Path(file).stat()
    if stat.S_ISDIR(status.st_mode):
        raise _refusal(name, file, "it is a directory", "give each file in it a name")
    if not stat.S_ISREG(status.st_mode):
        raise _refusal(name, file, "it is not a regular file", "give a file")
    if not os.access(file, os.R_OK):
        raise PermissionError
    return status.st_size


def _check_firm(name: str, file: str) -> None:
    with reached(file) as (_, place):
        if not place.is_roots and os.geteuid() == 0:
            reason = "users other than root could replace it"
            hint = "systemd reads it as root: keep it where only root can write, as in /etc"
            raise _refusal(name, file, reason, hint, ExitCode.NO_PERMISSION)


def _refusal(
    name: str, file: str, reason: str, hint: str, code: ExitCode = ExitCode.BAD_INPUT
) -> DoraSystemdError:
    return DoraSystemdError(f"cannot use {shown(file)} as credential {name}: {reason}", hint, code)

"""Finds which commands have something to build in a project; most have none, and pay nothing."""

import os
from pathlib import Path

from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import NodeKind
from dora_systemd.decisions.releases.build import built_nodes, has_builds, lock_places
from dora_systemd.decisions.settings.table import VENV
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.paths import exists
from dora_systemd.trust.sight import Sight, sight_of
from dora_systemd.verbs.start.account import account_of
from dora_systemd.verbs.start.plan import Plan


def find_builders(plan: Plan, dataflow: Dataflow, root: str) -> tuple[str, str]:
    """The paths of dora and of uv, "" for one that has nothing to do.

    dataflow: of the plan, as written. root: of the project.
    """
    has_nodes = bool(built_nodes(dataflow))
    modules = [node.raw.get("module") for node in dataflow.nodes if node.kind is NodeKind.MODULE]
    relative = os.path.relpath(plan.options.dataflow, root)
    is_locked = any(exists(f"{root}/{place}") for place in lock_places(relative))
    is_given = plan.settings.is_given(VENV)
    uv = ""
    if modules or (is_locked and not is_given):
        with sight_of(account_of(plan.user)) as sight:
            directory = Path(plan.options.dataflow).parent
            has_nodes = has_nodes or any(_has_builds(directory, one, sight) for one in modules)
            uv = _find_uv(plan, sight) if is_locked and not is_given else ""
    return plan.options.dora if has_nodes else "", uv


def _has_builds(directory: Path, module: object, sight: Sight) -> bool:
    """Whether the file of a module asks for a build; dora reports one that is not readable."""
    path = directory / str(module)
    try:
        return has_builds(parse_yaml(decoded(sight.read(str(path)), path), path))
    except (OSError, DoraSystemdError):
        return False


def _find_uv(plan: Plan, sight: Sight) -> str:
    places = plan.environment.get("PATH", "").split(os.pathsep)
    return next((one for one in (f"{at}/uv" for at in places if at) if sight.is_program(one)), "")

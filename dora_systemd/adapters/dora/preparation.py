"""Turns a descriptor on disk into what dora gets: the runner does this at every start."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dora_systemd.adapters.dora.command import refusal_reason, run_dora
from dora_systemd.adapters.host import files
from dora_systemd.decisions.cell.launch import LaunchPlan, launch_descriptor
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import (
    BuildSession,
    Dataflow,
    parse_dataflow,
    parse_session,
    session_path,
)
from dora_systemd.decisions.descriptor.nodes import UNEXPANDED
from dora_systemd.errors import bad_input
from dora_systemd.trust.programs import own_account
from dora_systemd.trust.sight import Sight

PACKAGE = Path(__file__).parents[2]


class Prepared(NamedTuple):
    """A dataflow that can be started."""

    dataflow: Dataflow  # with modules expanded
    plan: LaunchPlan
    descriptor: Mapping[str, Any]  # what dora gets


def prepare(
    options: RunnerOptions, environment: Mapping[str, str], is_reload: bool = False
) -> Prepared:
    """Read and rewrite the dataflow of `options`. environment: that of the nodes.

    is_reload: as of check_settings(). Raises DoraSystemdError if it is not readable or a node of it
    cannot run.
    """
    dataflow = load_dataflow(options)
    check_named_nodes(options, dataflow, is_reload)
    if options.machine:
        from dora_systemd.decisions.machines.part import own_dataflow

        dataflow = own_dataflow(options, dataflow)
    sight = Sight()
    plan = LaunchPlan(
        options,
        str(PACKAGE / "launcher.pl"),
        environment.get("PATH") or os.defpath,
        sight.exists,
        sight.read,
        _load_session(options, sight),
        environment,
    )
    if options.has("owes"):
        from dora_systemd.adapters.dora.probe import probe_python

        probe_python(plan)
    if options.has("record"):
        from dora_systemd.adapters.dora.probe import check_recorder

        check_recorder(plan)
    return Prepared(dataflow, plan, launch_descriptor(dataflow, plan))


def check_named_nodes(options: RunnerOptions, dataflow: Dataflow, is_reload: bool = False) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that does not exist, or cannot have a setting.

    dataflow: with modules expanded. is_reload: as of check_settings().
    """
    if options.settings:
        from dora_systemd.decisions.settings.runner import check_settings

        check_settings(options, dataflow.nodes, is_reload)


def resolved(options: RunnerOptions) -> RunnerOptions:
    """The options with the links and ".." in directories resolved, as dora does: nodes see them.

    The runner does this, because its user may own the links.
    """
    dataflow, directory = Path(options.dataflow), os.path.realpath(options.working_directory)
    file = str(Path(os.path.realpath(dataflow.parent), dataflow.name))
    return options._replace(dataflow=file, working_directory=directory)


def load_dataflow(options: RunnerOptions) -> Dataflow:
    """The dataflow of `options` with modules expanded. Raises DoraSystemdError."""
    path = Path(options.dataflow)
    dataflow = parse_dataflow(files.read_yaml(path), str(path))
    if not any(node.kind in UNEXPANDED for node in dataflow.nodes):
        return dataflow
    # This runs inside the cell, so as its user, and never as root for another user.
    account, directory = own_account(), str(path.parent)
    done = run_dora(options.dora, ["expand", str(path)], account, os.environ, directory)
    if done.status != 0:
        hint = f"see {options.dora} expand {path}"
        raise bad_input(f"cannot expand {path}: {refusal_reason(done)}", hint)
    return parse_dataflow(files.parse_yaml(done.stdout, path), str(path))


def _load_session(options: RunnerOptions, sight: Sight) -> BuildSession:
    path = Path(session_path(options.dataflow))
    if not sight.exists(str(path)):
        return BuildSession()
    return parse_session(files.read_yaml(path, allow_empty=True))

"""The part of a dataflow that one machine runs, and the nodes of others as dora gets them. Pure.

The member writes how each of its nodes is started, from what it finds on its own disk.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dora_systemd.decisions.cell.launch import (
    PERL,
    LaunchPlan,
    is_launched,
    launcher_words,
)
from dora_systemd.decisions.cell.machines import placed_on
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.machines.own import is_here
from dora_systemd.errors import DoraSystemdError, ExitCode

COPY_HINT = "copy the directory of the dataflow to that machine"


def format_other_file(path: str) -> str:
    """Why a member refuses its part if its descriptor is not that of the head."""
    return f"{path} is not the same file as on the head"


def own_dataflow(options: RunnerOptions, dataflow: Dataflow) -> Dataflow:
    """The dataflow with this machine's nodes only."""
    own = tuple(node for node in dataflow.nodes if is_here(options, node.id))
    return replace(dataflow, nodes=own)


def with_works(descriptor: Mapping[str, Any], works: Mapping[str, str]) -> dict[str, Any]:
    """The descriptor with dora's directory on each member. works: by machine."""
    nodes = [_with_work(node, works) for node in descriptor["nodes"]]
    return {**descriptor, "nodes": nodes}


def _with_work(node: Mapping[str, Any], works: Mapping[str, str]) -> Mapping[str, Any]:
    deploy = node.get("deploy") or {}
    machine = deploy.get("machine")
    return {**node, "deploy": {**deploy, "working_dir": works[machine]}} if machine else node


def check_placed(options: RunnerOptions, dataflow: Dataflow) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that only dora itself can start."""
    for node in dataflow.nodes:
        if (machine := placed_on(options.placed, node.id)) and not is_launched(node):
            raise DoraSystemdError(
                f"cannot start {dataflow.source}: node {node.id} cannot run on machine {machine}",
                "only nodes with a program or a Python file as their path can",
                ExitCode.BAD_INPUT,
            )


def launch_files(dataflow: Dataflow, plan: LaunchPlan) -> dict[str, str]:
    """What launch/NODE says, by node. Raises DoraSystemdError for a node that cannot run."""
    return {
        node.id: _launch_file(launcher_words(node, dataflow.source, plan))
        for node in dataflow.nodes
    }


def _launch_file(words: list[str]) -> str:
    return f"exec {', '.join(map(_perl_text, [PERL, *words]))};\n"


def _perl_text(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"

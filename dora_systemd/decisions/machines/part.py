"""The part of a dataflow that one machine runs, and whether its nodes run the head's files. Pure.

A member writes how each of its nodes is started, from what it finds on its own disk. It reports the
digests of its programs, and of what these import, by their path relative to the dataflow file. A
file that the head does not have proves nothing: it may be for that machine only.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from dora_systemd.decisions.cell.launch import PERL, LaunchPlan, is_launched, launcher_words
from dora_systemd.decisions.cell.machines import HEAD, machine_of, placed_on
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.errors import bad_input
from dora_systemd.terminal_text import short_line


def is_here(options: RunnerOptions, node: str) -> bool:
    """Whether this machine runs the node."""
    return machine_of(options.placed, node) == (options.machine or HEAD)


def own_options(options: RunnerOptions) -> RunnerOptions:
    """Return the options without those for nodes of other machines."""
    return options._replace(
        settings=tuple(
            one for one in options.settings if not one.node or is_here(options, one.node)
        ),
    )


COPY_HINT = "copy the directory of the dataflow to that machine"


def format_other_file(path: str) -> str:
    """Format why a member refuses its part: its descriptor differs from that of the head."""
    return f"{path} is not the same file as on the head"


def own_dataflow(options: RunnerOptions, dataflow: Dataflow) -> Dataflow:
    """The dataflow with this machine's nodes only."""
    own = tuple(node for node in dataflow.nodes if is_here(options, node.id))
    return dataflow._replace(nodes=own)


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
            raise bad_input(
                f"cannot start {dataflow.source}: node {node.id} cannot run on machine {machine}",
                "only nodes with a program or a Python file as their path can",
            )


def launch_files(dataflow: Dataflow, plan: LaunchPlan) -> dict[str, str]:
    """Format launch/NODE for each node. Raises DoraSystemdError for a node that cannot run."""
    return {
        node.id: _launch_file(launcher_words(node, dataflow.source, plan))
        for node in dataflow.nodes
    }


def _launch_file(words: list[str]) -> str:
    return f"exec {', '.join(map(_perl_text, [PERL, *words]))};\n"


def _perl_text(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


MOST_FILES = 500
_NAMED = 3
_LONGEST = 100
_DIGEST = 64
"""Hexadecimal digits of SHA-256."""

Digests = Mapping[str, str]
"""SHA-256 by relative path."""


def format_digests(digests: Digests) -> str:
    """The text for wire.Programs."""
    return json.dumps(dict(list(digests.items())[:MOST_FILES]))


def parse_digests(text: str) -> dict[str, str]:
    """The digests of a member, which can lie: without what is no path below the dataflow file.

    Raises ValueError for another text.
    """
    found = json.loads(text)
    if not isinstance(found, dict):
        raise ValueError(text)
    return {path: one for path, one in list(found.items())[:MOST_FILES] if _is_digest(path, one)}


def _is_digest(path: str, digest: object) -> bool:
    is_hex = isinstance(digest, str) and len(digest) == _DIGEST
    pure = PurePosixPath(path)
    return is_hex and "\0" not in path and not pure.is_absolute() and ".." not in pure.parts


def differing(here: Digests, there: Digests) -> list[str]:
    """Return the files that both machines have, with different contents."""
    return sorted(path for path, one in there.items() if here.get(path, one) != one)


def format_differing(found: Mapping[str, Sequence[str]]) -> str:
    """Format the files that differ as one line, "" if none does. found: by machine."""
    parts = (
        f"machine {machine} runs another {_names(files)} than the one here"
        for machine, files in found.items()
        if files
    )
    return "; ".join(parts)


def _names(files: Sequence[str]) -> str:
    names = ", ".join(short_line(one, _LONGEST) for one in files[:_NAMED])
    more = len(files) - _NAMED
    return f"{names} and {more} more" if more > 0 else names

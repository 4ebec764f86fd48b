"""Runs a dataflow by `dora run` and by `doractl run`, and reads what it did."""

import json
import os
import re
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.logs.lines import json_fields
from tests.system.cells import Cell, run
from tests.system.fidelity.flows import MARKS

_OTHERS = ("daemon", "spawner", "dora-systemd")
"""Targets of records about a node that are not the node's."""
Done = subprocess.CompletedProcess[str]


def run_both(flow: Path, cell: Cell, variables: Mapping[str, str], *words: str) -> list[Done]:
    """The two commands, each with `words` and `variables`, and lines as JSON."""
    given = (str(flow), "--log-format", "json", *words)
    commands = (("dora", "run"), ("doractl", cell.scope.flag, "run", "--name", cell.name))
    env = {**os.environ, **variables}
    return [run(*one, *given, cwd=flow.parent, env=env, check=False) for one in commands]


class Outcome(NamedTuple):
    """has_failed: by the exit status. said: node -> its marked lines, each stream in its order."""

    has_failed: bool
    said: Mapping[str, list[str]]


def read_outcome(status: int, printed: str) -> Outcome:
    """The outcome of a command. Statuses differ between kinds of failure, see doractl(1)."""
    said: dict[str, list[str]] = {}
    for node, line in lines_of(printed):
        if line.startswith(MARKS):
            said.setdefault(node, []).append(line)
    # The streams of a node are two pipes; nobody keeps the order between them.
    return Outcome(status != 0, {node: sorted(lines, key=_is_err) for node, lines in said.items()})


def lines_of(printed: str) -> Iterator[tuple[str, str]]:
    """Node and line of what nodes have written; of a record in JSON only its message."""
    for line in printed.split("\n"):
        record = json.loads(line) if line.startswith("{") else {}
        if record.get("node_id") and not str(record["target"]).startswith(_OTHERS):
            fields = json_fields(record["message"].encode()) or {}
            message = str(fields.get("MESSAGE", record["message"]))
            # A carriage return ends a line in the journal, or is a newline in a record.
            for part in re.split("[\r\n]", message):
                yield record["node_id"], part


def _is_err(line: str) -> bool:
    return line.startswith("err:")

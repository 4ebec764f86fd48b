"""Reads the files of programs, so that head and member can tell whether theirs are the same."""

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.own import is_here
from dora_systemd.decisions.machines.programs import MOST_FILES
from dora_systemd.runner.reload.sources import Sources
from dora_systemd.trust.eyes import read_regular

_MOST_BYTES = 32 << 20
"""Of one file: a larger one is not compared."""


def own_digests(
    options: RunnerOptions, prepared: Prepared, environment: Mapping[str, str]
) -> dict[str, str]:
    """The digests of the programs of this machine's nodes. Raises DoraSystemdError."""
    by_node = Sources(options, environment).files(prepared)
    files = {one for node, some in by_node.items() if is_here(options, node) for one in some}
    root = Path(options.dataflow).parent
    return read_digests(root, sorted(os.path.relpath(one, root) for one in files))


def read_digests(root: Path, paths: Iterable[str]) -> dict[str, str]:
    """The digests of the regular files among `paths`, which are relative to `root`."""
    found = {path: _digest(root / path) for path in list(paths)[:MOST_FILES] if path[:2] != ".."}
    return {path: one for path, one in found.items() if one}


def _digest(path: Path) -> str:
    try:
        data = read_regular(path, _MOST_BYTES + 1)
    except (OSError, ValueError):
        return ""
    return hashlib.sha256(data).hexdigest() if len(data) <= _MOST_BYTES else ""

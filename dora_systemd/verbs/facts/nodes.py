"""The nodes of a descriptor and the paths that they name, before dora has expanded it.

This does not run dora, which would have to run as the user and only reads the same files. It leaves
out unreadable files: the runner reports them at the start.
"""

import errno
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any

from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.files import read_file, unreadable
from dora_systemd.trust.sight import Sight
from dora_systemd.values import as_mapping

_MOST_FILES = 50
"""Maximum number of module files; they can refer to each other in a circle."""


def written_dataflow(path: str) -> Dataflow:
    """The dataflow in the file `path`, with modules unexpanded. Raises DoraSystemdError."""
    text = decoded(read_file(path).data, Path(path))
    return parse_dataflow(parse_yaml(text, Path(path)), path)


def named_places(dataflow: Dataflow, sight: Sight) -> Iterator[Path]:
    """The directories of modules, and of programs with absolute paths."""
    for node in dataflow.nodes:
        yield from _places(node.raw)
    queue = [
        PurePath(dataflow.source).parent / str(node.raw["module"])
        for node in dataflow.nodes
        if isinstance(node.raw.get("module"), str)
    ]
    for count, path in enumerate(queue):
        if count == _MOST_FILES:
            return
        yield Path(path.parent)
        for raw in _nodes_of(Path(path), sight):
            yield from _places(raw)
            if isinstance(raw.get("module"), str):
                queue.append(path.parent / raw["module"])


def _nodes_of(path: Path, sight: Sight) -> Iterator[dict[str, Any]]:
    try:
        data = sight.read(str(path))
    except OSError as error:
        if error.errno == errno.ENXIO:  # a FIFO: dora would wait for a writer forever
            raise unreadable(path, error) from error
        return
    with suppress(DoraSystemdError):
        document = parse_yaml(decoded(data, path), path)
        nodes = as_mapping(document).get("nodes")
        yield from (node for node in nodes or () if isinstance(node, dict))


def _places(raw: Any) -> Iterator[Path]:
    directory = as_mapping(raw.get("deploy")).get("working_dir")
    if isinstance(directory, str) and directory.startswith("/"):
        yield Path(directory)
    program = raw.get("path")
    if isinstance(program, str) and program.startswith("/"):
        yield Path(program).parent

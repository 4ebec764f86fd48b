"""The definition of a node of our own, which the runner adds to a run. Pure."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

_VARIABLES = {
    # One thread of dora's is enough for it. Each further one has an arena of malloc(3).
    "TOKIO_WORKER_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
    "RUST_LOG": "error",
}


def extra_definition(
    name: str,
    number: int,
    command: Sequence[str],
    launcher: tuple[str, str],
    inputs: Mapping[str, Mapping[str, Any]],
    variables: Mapping[str, str],
) -> dict[str, Any]:
    """The node for dora's descriptor. name: of its group, and the beginning of its id.

    number: of earlier nodes of that name in this run. command: the program. launcher: what executes
    the program.
    """
    interpreter, script = launcher
    return {
        "id": f"{name}.{number}",
        "path": interpreter,
        "args": shlex.join([script, name, "/", "keep", *command]),
        "inputs": {key: dict(one) for key, one in inputs.items()},
        "env": {**_VARIABLES, **variables},
        "restart_policy": "never",
        "max_log_size": "64KB",
        "max_rotated_files": 1,
    }

"""The probe: the node that hears what nodes owe, and notes when. Pure.

dora has no counter for an output, and inspection of topics copies every message to the coordinator.
A node beside the others with `queue_size: 1` leaves the path of the messages as it is: dora passes
it references to shared memory, which it does not look at. There is one probe for each dataflow, not
for each node. The runner adds it when all nodes are ready, so it delays no start.
benchmarks/README.md has what it costs.

The probe and the runner share a file of times: 8 bytes for the beat of the probe, then 8 for each
owed output, in their order, and for each other input of the nodes that owe them, see feeds.py;
CLOCK_MONOTONIC in µs, 0 is never. Nothing else passes between them.
"""

import shlex
import struct
from collections.abc import Sequence
from typing import Any

from dora_systemd.decisions.cell.owed import PROBE
from dora_systemd.values import SECOND

_SLOT = struct.Struct("=Q")
_VARIABLES = {
    # One thread of dora's is enough for it. Each further one has an arena of malloc(3).
    "TOKIO_WORKER_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
    "RUST_LOG": "error",
}


def probe_definition(
    number: int,
    command: Sequence[str],
    launcher: tuple[str, str],
    inputs: Sequence[tuple[int, str]],
) -> dict[str, Any]:
    """The probe as a node of dora's descriptor.

    number: how many there were before, in this run. command: the program. launcher: what executes
    it. inputs: the outputs to hear, NODE/OUTPUT, each with its slot in the file of times.
    """
    interpreter, script = launcher
    return {
        "id": f"{PROBE}.{number}",
        "path": interpreter,
        "args": shlex.join([script, PROBE, "/", "keep", *command]),
        "inputs": {f"{at}": {"source": one, "queue_size": 1} for at, one in inputs},
        "env": dict(_VARIABLES),
        "restart_policy": "never",
        "max_log_size": "64KB",
        "max_rotated_files": 1,
    }


def size_of_times(slots: int) -> int:
    """Bytes of the file of times."""
    return _SLOT.size * (1 + slots)


def parse_times(data: bytes, slots: int, now_us: int) -> tuple[int, tuple[int, ...]]:
    """The last beat of the probe, and the time of the last message of each of the first `slots`.

    All is 0 for data that no probe writes. A time after now_us is no time: the nodes' user can
    write the file.
    """
    if len(data) % _SLOT.size or not size_of_times(slots) <= len(data):
        return 0, (0,) * slots
    own = data[: size_of_times(slots)]
    beat, *heard = (one if one <= now_us + SECOND else 0 for (one,) in _SLOT.iter_unpack(own))
    return beat, tuple(heard)

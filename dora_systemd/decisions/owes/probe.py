"""The probe: a node that receives the owed outputs, and what it records of inputs. Pure.

dora has no counter for an output, and inspection of topics copies every message to the coordinator.
An additional node with `queue_size: 1` leaves the path of the messages as it is: dora passes
references to shared memory, which the probe does not open. There is one probe for each dataflow,
not for each node. The runner adds the probe when all nodes are ready, which delays no start.
benchmarks/README.md has what the probe costs.

The probe and the runner share a file of times: 8 bytes for the beat of the probe, then 8 for each
owed output, in their order, and for each other input of the nodes that owe them; CLOCK_MONOTONIC in
µs, 0 is never. Nothing else passes between them. A node that owes an output, and gets no input
itself, is starved.
"""

import shlex
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dora_systemd.decisions.cell.extra import PROBE, extra_id
from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.descriptor.dataflow import Dataflow, downstream_of
from dora_systemd.values import SECOND

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
    """The node for dora's descriptor. name: PROBE or RECORDER.

    number: of earlier nodes of that name in this run. command: the program. launcher: what executes
    the program.
    """
    interpreter, script = launcher
    return {
        "id": extra_id(name, number),
        "path": interpreter,
        "args": shlex.join([script, name, "/", "keep", *command]),
        "inputs": {key: dict(one) for key, one in inputs.items()},
        "env": {**_VARIABLES, **variables},
        "restart_policy": "never",
        "max_log_size": "64KB",
        "max_rotated_files": 1,
    }


_SLOT = struct.Struct("=Q")


def probe_definition(
    number: int,
    command: Sequence[str],
    launcher: tuple[str, str],
    inputs: Sequence[tuple[int, str]],
) -> dict[str, Any]:
    """The probe as a node of dora's descriptor.

    number: of earlier probes in this run. command: the program. launcher: what executes the
    program. inputs: the outputs to receive, NODE/OUTPUT, each with its slot in the file of times.
    """
    own = {f"{at}": {"source": one, "queue_size": 1} for at, one in inputs}
    return extra_definition(PROBE, number, command, launcher, own, {})


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


MOST_FEEDS = 64
"""Maximum inputs that are watched, besides owed outputs."""
_REGULAR = 4
"""Times `within` after which an input without a gap counts as regular."""


@dataclass(frozen=True)
class Feeds:
    """The inputs of owing nodes that the probe receives, too."""

    # NODE/OUTPUT of each slot in the file of times: the owed outputs, then the others
    places: tuple[str, ...] = ()
    # the slots of the inputs of each owing node
    by_node: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    # the nodes of which the probe receives every input: no timer, and none from another machine
    whole: frozenset[str] = frozenset()


NO_FEEDS = Feeds()


@dataclass(frozen=True)
class Flow:
    """The state of one input. Times in µs."""

    heard: int = 0  # its last message, CLOCK_MONOTONIC
    steady: int = 0  # how long messages came without a gap longer than `within`
    quiet: int = 0  # time that counts since the last message

    def after(self, heard: int, step: int, within: int) -> "Flow":
        """The flow after a look. step: µs that count."""
        quiet = self.quiet + step
        if heard > self.heard:
            return Flow(heard, 0 if quiet > within else self.steady + quiet)
        return replace(self, quiet=quiet)


def find_feeds(owes: Sequence[Owed], dataflow: Dataflow, is_here: Callable[[str], bool]) -> Feeds:
    """The feeds of the nodes in `owes`. is_here: whether this machine runs that node.

    The probe receives no messages of other machines: each would cross the network a second time. In
    a circle the input of a node ends because its output does, so it proves nothing.
    """
    slots = {one.place: at for at, one in enumerate(owes)}
    owing, downstream = {one.node for one in owes}, downstream_of(dataflow)
    by_node: dict[str, tuple[int, ...]] = {}
    whole = set[str]()
    for node in dataflow.nodes:
        if node.id not in owing:
            continue
        places = sorted({one.source for one in node.inputs})
        never = {"dora", node.id, *downstream[node.id]}
        heard = [one for one in places if _origin(one) not in never and is_here(_origin(one))]
        heard = [one for one in heard if one in slots or len(slots) < len(owes) + MOST_FEEDS]
        by_node[node.id] = tuple(slots.setdefault(one, len(slots)) for one in heard)
        whole |= {node.id} if places and len(heard) == len(places) else set()
    return Feeds(tuple(slots), by_node, frozenset(whole))


def starved_of(
    flows: Sequence[Flow], quiet: int, tick: int, owed: Owed, is_first: bool, is_whole: bool
) -> int | None:
    """Which of the flows a silent node lacks; None if the silence is its own.

    quiet: µs since its last message, or since its start if is_first. It is starved if nothing at
    all came in since then, or if a regular input ended when its output did.
    """
    least = quiet - 2 * tick
    ended = [at for at, one in enumerate(flows) if one.quiet >= least]
    if is_whole and ended and len(ended) == len(flows):
        return ended[0]
    most = quiet + owed.within
    regular = (at for at in ended if flows[at].steady >= _REGULAR * owed.within)
    return next((at for at in regular if is_first or flows[at].quiet <= most), None)


def _origin(source: str) -> str:
    return source.partition("/")[0]

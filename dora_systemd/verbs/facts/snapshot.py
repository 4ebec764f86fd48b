"""All dataflows of a manager at one moment, for who compares several of them."""

from collections.abc import Mapping

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup.strain import read_strain
from dora_systemd.decisions.resources.usage import Strain
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import Reading, read_dataflow, row_of


def read_snapshot(manager: Manager, scope: Scope) -> list[Observed]:
    """Every dataflow that systemd knows, those that have failed as well."""
    return [observe(read_dataflow(manager, scope, cell)) for cell in read_cells(manager)]


def observe(reading: Reading) -> Observed:
    """What a look at a dataflow shows of it, with what its groups had to wait for."""
    restarts = reading.unit["NRestarts"]
    return Observed(
        row_of(reading),
        reading.at_us,
        restarts,
        reading.usage,
        read_strains(reading),
        reading.status.lines,
    )


def read_strains(reading: Reading) -> Mapping[str, Strain]:
    """What each group of a dataflow had to wait for."""
    return {key: read_strain(path) for key, path in reading.groups.items()}

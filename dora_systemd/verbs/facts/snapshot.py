"""Reads all dataflows of a manager at one moment, for top, metrics and the page."""

from collections.abc import Mapping

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup.strain import read_strain
from dora_systemd.decisions.resources.usage import Strain
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import row_of
from dora_systemd.verbs.facts.reading import Reading, read_dataflow


def read_snapshot(manager: Manager, scope: Scope) -> list[Observed]:
    """All dataflows that systemd has loaded, including failed ones."""
    return [observe(read_dataflow(manager, scope, cell)) for cell in read_cells(manager)]


def observe(reading: Reading) -> Observed:
    """What a reading shows of a dataflow, with its pressure stall information."""
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
    """The pressure stall information of each group of a dataflow."""
    return {key: read_strain(path) for key, path in reading.groups.items()}

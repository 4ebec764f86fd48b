"""What notices need of a dataflow: read as soon as it has failed, for systemd may unload its unit.

The unit of a dataflow that is stopped after a failure is gone in a moment, and with it the setting,
the sandbox of the nodes, and the memory of the recorder. `doranotice-hold@.service` keeps the unit
until the service is ready. From then on all of it is here.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.cell.black_box import BlackBox
from dora_systemd.decisions.notice.command import is_command, words_of
from dora_systemd.decisions.notice.unit import names_to_copy
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.rings import RingFile
from dora_systemd.verbs.facts.cells import Cell, read_cell


class Noticed(NamedTuple):
    """A dataflow with the setting on_failure or black_box."""

    cell: Cell
    types: Mapping[str, str]  # of properties, by name
    copied: Mapping[str, Any]  # properties that the command has in common with the nodes
    environment: Sequence[str]  # that of the nodes

    @property
    def box(self) -> BlackBox | None:
        """The setting black_box."""
        box: BlackBox | None = self.cell.options.of_dataflow("black_box")
        return box


def read_noticed(manager: Manager, name: str) -> Noticed | None:
    """Read the dataflow `name`; None if systemd does not know it, or it has no such setting.

    Raises DoraSystemdError.
    """
    cell = read_cell(manager, unit_name(name))
    if cell is None or not cell.options.is_noticed:
        return None
    if not is_command(words_of(cell.options)):
        return Noticed(cell, {}, {}, ())
    types = manager.property_types()
    copied = manager.read(cell.unit, names_to_copy(types))
    environment = manager.read(cell.unit, ["Environment"])["Environment"]
    return Noticed(cell, types, copied, environment or ())


class Memory:
    """What was read last of a dataflow, and the ring of its recorder, which is open."""

    def __init__(self, manager: Manager, scope: Scope, name: str) -> None:
        self._manager, self._scope, self._name = manager, scope, name
        self.noticed: Noticed | None = None
        self._ring: RingFile | None = None

    def learn(self) -> None:
        """Read the dataflow again, if systemd has it still.

        A failure is reported as the dataflow was set then, also if the setting is gone now.
        """
        with suppress(DoraSystemdError):
            if noticed := read_noticed(self._manager, self._name):
                self.noticed = noticed
                self._open_ring(noticed)

    def _open_ring(self, noticed: Noticed) -> None:
        if noticed.box is None or not noticed.cell.options.has("record"):
            return
        # Imported late: few dataflows have a recorder.
        from dora_systemd.verbs.bundles.recording import find

        if ring := find(self._manager, self._scope, noticed.cell, noticed.cell.uuid):
            self.close_ring()
            self._ring = ring

    def ring_of(self, uuid: str) -> RingFile | None:
        """The ring of the dataflow with that UUID, if there is one."""
        ring = self._ring
        return ring if ring and ring.header.facts.get("uuid") == uuid else None

    def close_ring(self) -> None:
        """Give back the memory of a recorder that systemd has closed meanwhile."""
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    @property
    def is_loaded(self) -> bool:
        """Whether systemd has the dataflow. Raises DoraSystemdError."""
        return read_cell(self._manager, unit_name(self._name)) is not None

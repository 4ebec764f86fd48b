"""What head and members have in common: some nodes of their dataflow run elsewhere."""

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.machines.own import own_options
from dora_systemd.decisions.machines.part import own_dataflow
from dora_systemd.runner.cell.role import Alone
from dora_systemd.values import INFINITY


class Shared(Alone):
    """One of several machines."""

    @property
    def start_timeout(self) -> int:
        """Never: the time begins when all members have joined, and the head measures it."""
        return INFINITY

    def own(self, options: RunnerOptions) -> RunnerOptions:
        """The options without what they say of other machines' nodes."""
        return own_options(options)

    def here(self, dataflow: Dataflow) -> Dataflow:
        """The dataflow without other machines' nodes."""
        return own_dataflow(self.options, dataflow)

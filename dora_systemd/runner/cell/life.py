"""What the node table tells of the life of a unit: the same for all its runs, as in systemd."""

import time


class Life:
    """The time between two starts of the unit. uuid: of the dataflow.

    is_first: whether systemd has certainly not restarted the unit. up_us: CLOCK_MONOTONIC µs, as
    ActiveEnterTimestampMonotonic=; 0 before that.
    """

    def __init__(self, uuid: str, is_first: bool = False) -> None:
        self.uuid, self.is_first, self.up_us = uuid, is_first, 0

    def become_up(self) -> None:
        """The nodes are ready. A run after a reload changes nothing: the unit has been up."""
        self.up_us = self.up_us or time.monotonic_ns() // 1000

"""The notify sockets of a dataflow whose nodes have none."""

from dora_systemd.decisions.signs.table import Sign


class NoSigns:
    """What the rest of the runner knows of notify sockets."""

    is_used = False

    def make(self, node: str) -> None:
        """The node is about to be started. Raises OSError and DoraSystemdError."""

    def remove(self, node: str) -> None:
        """The node does not come back."""

    def forget(self, node: str) -> None:
        """The node's process has ended."""

    def table(self) -> dict[str, Sign]:
        """What the nodes have said of themselves."""
        return {}

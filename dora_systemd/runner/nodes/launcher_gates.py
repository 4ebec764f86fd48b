"""The gates of nodes: a launcher waits at a gate before it executes the node's program.

Nodes with needs have a gate, and nodes that were stopped by a request.

A gate is a FIFO. launcher.pl opens it for reading, which waits until the runner has it open, and
reads one word. So a gate is open for as long as the runner holds its descriptor and the FIFO
contains words. All launchers that read a word start the node: dora may start the node several
times. When the runner closes the gate, the kernel drops the rest, and the next launcher waits.
"""

import contextlib
import os
from collections.abc import Iterable

from dora_systemd.decisions.cell.exits import Exit, ExitKind
from dora_systemd.paths import CellPaths

_GO, _LEAVE = b"go.", b"e00"
_WORDS = 1024
"""Words that an open gate has at most: dora starts a node less than twice a second."""


class Gates:
    """All gates; none of them is open at first."""

    def __init__(self, paths: CellPaths) -> None:
        self._paths = paths
        self._open: dict[str, int] = {}
        self._known: set[str] = set()
        self._passing: set[str] = set()
        self._needing: set[str] = set()
        self._is_over = False

    def make(self, nodes: Iterable[str]) -> None:
        """Create closed gates for `nodes`, for a new run of the dataflow. Raises OSError."""
        self._is_over = False
        self._needing = set(nodes)
        for node in self._known - self._needing:  # of nodes that were stopped in the run before
            self.close(node)
            self._paths.node_gate(node).unlink(missing_ok=True)
        self._known = set()
        for node in self._needing:
            self.close(node)
            self.add(node)

    def add(self, node: str) -> None:
        """Create a gate for one more node, unless it has one. Raises OSError."""
        self._known.add(node)
        with contextlib.suppress(FileExistsError):
            os.mkfifo(self._paths.node_gate(node), 0o600)

    def reset(self, node: str) -> None:
        """Close the gate of a node with needs; remove the gate of any other node."""
        if node in self._known:
            self.close(node)
        if not self.is_for_needs(node):
            self._known.discard(node)
            self._paths.node_gate(node).unlink(missing_ok=True)

    def is_for_needs(self, node: str) -> bool:
        """Whether the gate of the node opens when its needs are met."""
        return node in self._needing

    def is_passing(self, node: str) -> bool:
        """Return whether the gate is open, so that launchers of the node start it."""
        return node in self._passing

    def open(self, node: str) -> None:
        """Open the gate, so that every launcher of the node starts it. Raises OSError."""
        self._fill(node, _GO)
        self._passing.add(node)

    def end(self, node: str, exit: Exit) -> None:
        """Have every launcher of the node end as the node has ended. Raises OSError."""
        self._passing.discard(node)
        self._fill(node, _word_of(exit))

    def leave(self, node: str) -> None:
        """Have the launcher of a stopped node end with success. Raises OSError."""
        self._passing.discard(node)
        self._fill(node, _LEAVE)

    def close(self, node: str) -> None:
        """Close the gate, so that the launchers of the node wait."""
        self._passing.discard(node)
        if (fd := self._open.pop(node, None)) is not None:
            self._empty(fd)
            os.close(fd)

    def dismiss(self) -> None:
        """End the launchers that wait, because the run is about to end; other nodes run on."""
        self._is_over = True
        for node in self._known - self._passing:
            with contextlib.suppress(OSError):  # the whole directory may be gone
                self._fill(node, _LEAVE, is_last=True)

    def remove(self) -> None:
        """Remove the gates: the next run of the dataflow makes those that it needs."""
        for node in self._known:
            self.close(node)
            with contextlib.suppress(OSError):
                self._paths.node_gate(node).unlink()
        self._known = set()

    def _fill(self, node: str, word: bytes, is_last: bool = False) -> None:
        if self._is_over and not is_last:
            return
        if node not in self._open:
            # For reading, too: then open(2) does not wait, and the FIFO has a reader at any time.
            flags = os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW
            self._open[node] = os.open(self._paths.node_gate(node), flags)
        fd = self._open[node]
        self._empty(fd)
        os.write(fd, word * _WORDS)

    @staticmethod
    def _empty(fd: int) -> None:
        with contextlib.suppress(BlockingIOError):
            while os.read(fd, 3 * _WORDS):
                pass

    def refill(self, node: str) -> None:
        """Refill an open gate after dora has started the node, whose launcher has read a word."""
        if node in self._passing:
            self.open(node)


def _word_of(exit: Exit) -> bytes:
    letter = b"s" if exit.kind is ExitKind.SIGNAL else b"e"
    number = exit.number if exit.kind in (ExitKind.SIGNAL, ExitKind.CODE) else 1
    return b"%c%02x" % (letter, number & 0xFF)

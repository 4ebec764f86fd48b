"""Which records to show: `--log-level` and `--log-filter`, in the terms of the dora command."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dora_systemd.decisions.logs.records import DORA_LEVELS, Record, level_of, record_text
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted

RAW = "stdout"
"""The level that shows everything, also raw lines of nodes, which have no level of their own."""
FILTER_LEVELS = (*DORA_LEVELS[1:], RAW)


@dataclass(frozen=True)
class LogFilter:
    """The levels to show. nodes: those of single nodes by id; level: of all other records."""

    level: str = RAW
    nodes: Mapping[str, str] = field(default_factory=dict)

    def shows(self, record: Record) -> bool:
        """Whether to show the record: raw lines only at the level "stdout", as in dora."""
        asked = self.nodes.get(record_text(record, "DORA_NODE"), self.level)
        own = level_of(record)
        return asked == RAW or own in DORA_LEVELS[: DORA_LEVELS.index(asked) + 1]


def parse_filter(text: str) -> dict[str, str]:
    """The level of each node in "NODE=LEVEL,...". Raises DoraSystemdError (USAGE)."""
    return dict(_parsed(pair) for one in text.split(",") if (pair := one.strip()))


def _parsed(pair: str) -> tuple[str, str]:
    node, _, level = (part.strip() for part in pair.partition("="))
    level = level.lower()
    if not node or level not in FILTER_LEVELS:
        hint = f"write NODE=LEVEL,...; levels: {', '.join(FILTER_LEVELS)}"
        raise DoraSystemdError(f"cannot read {quoted(pair)} as a log filter", hint, ExitCode.USAGE)
    return node, level

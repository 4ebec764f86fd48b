"""What the text of a dataflow shows to a caller who may not read its table. Pure."""

import re

from dora_systemd.decisions.cell.status import GATHERING, STAGES, UNMET
from dora_systemd.decisions.needs.waiting import WAITS

_COUNT = r"[0-9]+/[0-9]+ nodes "
_TEXTS = {
    rf"{_COUNT}running; (?:.*; )?(?:failed|silent): ": "degraded",
    rf"{_COUNT}.*{WAITS}": UNMET,
    "waiting for ": GATHERING,
    "stopping": "stopping",
}
"""The stage by the beginning of STATUS=."""


def stage_of_text(text: str) -> str:
    """Return the stage that STATUS= shows, for a caller who may not read the table."""
    stages = (stage for begin, stage in _TEXTS.items() if re.match(begin, text))
    return next(stages, STAGES[0])

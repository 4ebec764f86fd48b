"""What a machine remembers of its power cuts, in a file that each of them leaves as it is."""

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tests.system.deploy.kills import Course, Moment

PLACE = Path("/var/lib/dora-systemd-power.json")


@dataclass
class Notes:
    """course: of whole commands. version: of the project. old: the release that ran before the cut.

    moment: of that cut. rows: of the table, one for each cut that has been looked at.
    """

    course: Course
    version: int
    old: str = ""
    moment: Moment = field(default_factory=lambda: Moment(""))
    rows: list[list[str]] = field(default_factory=list)
    failed: int = 0

    def write(self) -> None:
        """Write them to the disk for good."""
        new = PLACE.with_suffix(".new")
        with new.open("w") as file:
            json.dump(asdict(self), file)
            file.flush()
            os.fsync(file.fileno())
        new.replace(PLACE)
        os.sync()


def read_notes() -> Notes | None:
    """Those of the cuts before, None before the first."""
    if not PLACE.exists():
        return None
    value = json.loads(PLACE.read_text())
    course, moment = Course(*value.pop("course")), Moment(*value.pop("moment"))
    return Notes(course=course, moment=moment, **value)

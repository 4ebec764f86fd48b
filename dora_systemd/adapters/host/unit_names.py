"""The names of units in a directory of systemd. Imports only what is loaded anyway."""

import contextlib
import os
from pathlib import Path


def has_unit(directory: Path, prefix: str) -> bool:
    """Whether a unit in this directory has a name that begins so; False if it is not readable."""
    with contextlib.suppress(OSError), os.scandir(directory) as entries:
        return any(one.name.startswith(prefix) for one in entries)
    return False

"""Run dora dataflows as systemd services."""

import sys

__version__ = "0.1.0"

if sys.version_info < (3, 11):  # noqa: UP036 - what follows would fail in a riddle
    sys.exit(
        "doractl: cannot run with Python %d.%d: 3.11 or newer is needed\n"  # noqa: UP031
        "hint: uv tool install --python 3.11 dora-systemd" % sys.version_info[:2]
    )

"""Makes the next reboot a power cut: the kernel starts the machine anew, nothing is stopped."""

import os
from pathlib import Path

from tests.boot.flows import NOTES
from tests.system.cells import run, wait_for

READY = Path("/run/power-cut")
# It runs already, and systemd stops it before the dataflows: a process that the reboot has to
# start, or that is stopped with them, may come when a slow machine has their end on its disk.
UNIT = f"""
[Unit]
After=dora-begun.service dora-running.service user@1000.service
[Service]
ExecStart=/bin/sh -c 'echo 1 >/proc/sys/kernel/sysrq; trap "echo b >/proc/sysrq-trigger" TERM; \\
    touch {READY}; while :; do sleep 1000 & wait; done'
"""


def test_prepare() -> None:
    """Only what is the user's own is written to disk for them; unit files are our business."""
    for path in (NOTES, *Path("/srv").glob("*/*"), *Path("/home/alice/mine").glob("*")):
        with path.open("rb") as file:
            os.fsync(file.fileno())
    run("journalctl", "--sync")
    Path("/run/systemd/system/power-cut.service").write_text(UNIT)
    run("systemctl", "daemon-reload")
    run("systemctl", "start", "power-cut.service")
    wait_for("the shell that waits", READY.exists)

"""Makes the next reboot a power cut: the kernel starts the machine anew, nothing is stopped."""

import os
from pathlib import Path

from tests.boot.flows import NOTES
from tests.system.cells import run

UNIT = """
[Unit]
DefaultDependencies=no
[Service]
ExecStart=/bin/sh -c 'echo 1 >/proc/sys/kernel/sysrq; echo b >/proc/sysrq-trigger'
"""


def test_prepare() -> None:
    """Only what is the user's own is written to disk for them; unit files are our business."""
    for path in (NOTES, *Path("/srv").glob("*/*"), *Path("/home/alice/mine").glob("*")):
        with path.open("rb") as file:
            os.fsync(file.fileno())
    run("journalctl", "--sync")
    units = Path("/run/systemd/system")
    (units / "reboot.target.d").mkdir(parents=True)
    (units / "reboot.target.d/cut.conf").write_text("[Unit]\nWants=power-cut.service\n")
    (units / "power-cut.service").write_text(UNIT)
    run("systemctl", "daemon-reload")

"""The packages are taken away while a robot runs: tests/system/transcripts/uninstall.txt."""

import shutil
from pathlib import Path

from tests.deb import packages
from tests.system.typed import Shell, replay

PLACE = Path("/srv/robot")
TASK = packages.CHECKOUT / "tests/system/transcripts/uninstall.txt"


def test_uninstall() -> None:
    packages.install()
    shutil.copytree(packages.ROBOT, PLACE)
    packages.make_venv(PLACE / ".venv")
    shell = Shell(packages.caller("root"), PLACE)
    try:
        wrong = replay(shell, TASK.read_text())
    finally:
        shell.end()
        packages.sh(f"dpkg --purge {' '.join(packages.PACKAGES)}")  # those that are left
        shutil.rmtree(PLACE)
    assert not wrong, f"{TASK.name} differs:\n" + "".join(wrong)

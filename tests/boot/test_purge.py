"""Last of all: the packages are removed while dataflows run, and purged with what is enabled."""

import json
from pathlib import Path

from tests.boot.flows import NOTES
from tests.deb import packages
from tests.system.cells import dora_processes

ETC = Path("/etc/systemd/system")


def test_remove_stops_dataflows_and_leaves_what_is_enabled() -> None:
    assert dora_processes()
    packages.apt("remove", "--yes", *packages.PACKAGES)
    assert not dora_processes()
    assert (ETC / "dora.target.wants/dora-running.service").exists()


def test_purge_leaves_nothing_of_the_system() -> None:
    """Units of somebody else stay, and so does what users have enabled for themselves."""
    before = {*json.loads(NOTES.read_text())["files"], str(NOTES)}
    foreign = ETC / "dora-foreign.service"
    foreign.write_text("[Service]\nExecStart=/bin/true\n")
    packages.apt("purge", "--yes", *packages.PACKAGES)
    assert {path for path in packages.files() - before if "dora" in path} == {str(foreign)}
    assert list(Path("/home/alice/.config/systemd/user").glob("dora-mine.service"))

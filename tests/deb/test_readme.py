"""README.md and pages of docs/, typed on a machine with the packages, by a person in a shell.

Every line that begins with "$ " is typed; what it prints is compared with what stands below it.
"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deb import packages
from tests.deb.packages import sh
from tests.deb.typed_pages import FROM_NOTHING, WITH_ROBOT
from tests.system.ports import reserve_ports
from tests.system.typed import Shell, Typed, as_text, type_line, typed_lines

NO_MEMORY = not Path("/sys/fs/cgroup/cgroup.controllers").read_text().count("memory")
"""Containers whose kernel has memory in cgroup v1 refuse a limit, as doractl should."""
KEYS = {"doractl top": ("plot", b"q"), "doractl run": ("frame ", b"\x03")}
"""Commands that wait for a key: when to press it, and which."""
PLACE, ARM = Path("/srv/robot"), Path("/srv/arm")
LEFT = "/srv/records /etc/systemd/system/notify.service"
"""What pages make elsewhere."""
EXAMPLES = Path("/usr/share/doc/dora-systemd/examples")


def lines_of(page: str) -> Iterator[Typed]:
    """Each line of a page that is typed, and what it prints."""
    text = (packages.CHECKOUT / page).read_text(encoding="utf-8")
    for block in re.findall(r"^```\n(\$ .*?)^```", text, re.DOTALL | re.MULTILINE):
        yield from typed_lines(block)


@pytest.fixture(scope="module")
def installed() -> Iterator[None]:
    reserve_ports()
    packages.install()
    if not EXAMPLES.exists():
        # The image leaves out /usr/share/doc, as images of containers do.
        shutil.copytree(packages.ROBOT.parent, EXAMPLES)
    yield
    packages.apt("purge", "--yes", *packages.PACKAGES)


@pytest.fixture
def shell(installed: None) -> Iterator[Shell]:
    del installed
    # A new machine has no dataflows that have ended.
    sh("journalctl --quiet --rotate && journalctl --quiet --vacuum-time=1us")
    shell = Shell(packages.caller("root"), Path("/"), KEYS)
    yield shell
    shell.end()
    sh("doractl destroy --force")
    sh(f"rm -rf {PLACE} {ARM} {LEFT}")


@pytest.mark.parametrize("page", [*FROM_NOTHING, *WITH_ROBOT])
def test_it_prints_what_stands_there(shell: Shell, page: str) -> None:
    wrong = []
    if page in WITH_ROBOT:
        shutil.copytree(EXAMPLES / "robot", PLACE)
        packages.make_venv(PLACE / ".venv")
    for typed in lines_of(page):
        if "pip install" in typed.line:
            # The lab's machines reach no index; theirs is the same, from the image.
            packages.make_venv((ARM if "arm" in page else PLACE) / ".venv")
            continue
        shown, status = type_line(shell, typed)
        if NO_MEMORY and "memory" in typed.line:
            assert "cgroup controller" in shown
            continue
        if not typed.fits(shown, status):
            wrong.append(as_text(typed.line, shown, status))
        print(as_text(typed.line, shown, status), end="")
    assert not wrong, "\n".join(wrong)

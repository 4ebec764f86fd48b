"""README.md typed from top to bottom on a machine with the packages, by a person in a shell.

Every line that begins with "$ " is typed; what it prints is compared with what stands below it.
"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deb import packages
from tests.deb.packages import sh
from tests.system.ports import reserve_ports
from tests.system.typed import Shell, Typed, as_text, typed_lines

NO_MEMORY = not Path("/sys/fs/cgroup/cgroup.controllers").read_text().count("memory")
"""Containers whose kernel has memory in cgroup v1 refuse a limit, as doractl should."""
README = (packages.CHECKOUT / "README.md").read_text(encoding="utf-8")
KEYS = {"doractl top": ("plot", b"q"), "doractl run": ("frame ", b"\x03")}
"""Commands that wait for a key: when to press it, and which."""
PLACE = Path("/srv/robot")
EXAMPLE = Path("/usr/share/doc/dora-systemd/examples/robot")


def readme_lines() -> Iterator[Typed]:
    """Each line that is typed, and what it prints."""
    section = README[README.index("## Five minutes") : README.index("What happened, at three")]
    for block in re.findall(r"^```\n(.*?)^```", section, re.DOTALL | re.MULTILINE):
        yield from typed_lines(block)


@pytest.fixture(scope="module")
def shell() -> Iterator[Shell]:
    reserve_ports()
    packages.install()
    if not EXAMPLE.exists():
        # The image leaves out /usr/share/doc, as images of containers do.
        shutil.copytree(packages.ROBOT, EXAMPLE)
    # A new machine has no dataflows that have ended.
    sh("journalctl --quiet --rotate && journalctl --quiet --vacuum-time=1us")
    shell = Shell(packages.caller("root"), Path("/"), KEYS)
    yield shell
    shell.end()
    sh("doractl destroy --force")
    packages.apt("purge", "--yes", *packages.PACKAGES)
    sh(f"rm -rf {PLACE}")


def test_it_prints_what_stands_there(shell: Shell) -> None:
    wrong = []
    for typed in readme_lines():
        if "pip install" in typed.line:
            # The lab's machines reach no index; theirs is the same, from the image.
            packages.make_venv(PLACE / ".venv")
            continue
        shown, status = shell.run(typed.line)
        if NO_MEMORY and "memory" in typed.line:
            assert "cgroup controller" in shown
            continue
        if not typed.fits(shown, status):
            wrong.append(as_text(typed.line, shown, status))
        print(as_text(typed.line, shown, status), end="")
    assert not wrong, "\n".join(wrong)

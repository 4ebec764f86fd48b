"""README.md from nothing to "3/3", typed by root and by an ordinary user, and how long that takes.

Nothing is downloaded: the packages are in dist/, and the image has what they need, and what the
nodes import.
"""

import pwd
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deb import packages
from tests.deb.picture import lines_of_readme
from tests.lab.pace import bound, pace
from tests.system.cells import run
from tests.system.typed import Shell, Typed, as_text, type_line

SECONDS = 60.0
"""Of an idle machine, besides downloads."""
EXAMPLES = Path("/usr/share/doc/dora-systemd/examples")
PLACES = {"root": Path("/srv"), "alice": Path("/home/alice")}


def install_line() -> Typed:
    """What README.md says to type in the directory of this checkout, as root."""
    text = (packages.CHECKOUT / "README.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^```\n(apt install .*)\n```", text, re.MULTILINE)
    return Typed(line, None)


def lines_until_all_run() -> Iterator[Typed]:
    """Those of the first minute, until `list` shows all nodes."""
    for typed in lines_of_readme():
        yield typed
        if "3/3" in (typed.shown or ""):
            return


@pytest.fixture(params=PLACES)
def user(request: pytest.FixtureRequest) -> Iterator[str]:
    """Somebody on a machine without the packages."""
    name = str(request.param)
    run("dpkg", "--purge", *packages.PACKAGES)
    yield name
    packages.sh(f"{runtime_of(name)} doractl destroy --force", name)
    shutil.rmtree(PLACES[name] / "robot")


def runtime_of(user: str) -> str:
    """The assignment that a login makes."""
    return f"XDG_RUNTIME_DIR=/run/user/{pwd.getpwnam(user).pw_uid}"


def timed(shell: Shell, typed: Typed) -> float:
    """The seconds that a line takes, which has to do what stands below it."""
    begun = time.monotonic()
    shown, status = type_line(shell, typed)
    assert typed.fits(shown, status), as_text(typed.line, shown, status)
    return time.monotonic() - begun


def test_less_than_a_minute(user: str, capsys: pytest.CaptureFixture[str]) -> None:
    root = Shell(packages.caller("root"), packages.CHECKOUT)
    taken = [timed(root, install_line())]
    root.end()
    if not EXAMPLES.exists():
        # The image leaves out /usr/share/doc, as images of containers do.
        shutil.copytree(packages.ROBOT.parent, EXAMPLES)
    place = PLACES[user]
    shell = Shell((*packages.caller(user), "env", runtime_of(user)), Path("/"))
    for typed in lines_until_all_run():
        line = typed.line.replace("/srv", str(place))
        if is_download := "pip install" in line:
            line = line.partition(" && ")[0]
        taken.append(timed(shell, typed._replace(line=line)))
        if is_download:
            packages.make_venv(place / "robot/.venv")
    shell.end()
    with capsys.disabled():
        each = ", ".join(f"{one:.1f}" for one in taken)
        print(f"\nREADME.md to 3/3 as {user}: {sum(taken):.1f} s ({each}), pace {pace():.1f}")
    assert sum(taken) < bound(SECONDS)

"""README.md typed from top to bottom on a machine with the packages, by a person in a shell.

Every line that begins with "$ " is typed; what it prints is compared with what stands below it,
where "..." stands for anything (doctest's ELLIPSIS).
"""

import doctest
import os
import re
import select
import shutil
import subprocess
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deb import packages
from tests.deb.packages import sh
from tests.lab.pace import bound

NO_MEMORY = not Path("/sys/fs/cgroup/cgroup.controllers").read_text().count("memory")
"""Containers whose kernel has memory in cgroup v1 refuse a limit, as doractl should."""
README = (packages.CHECKOUT / "README.md").read_text(encoding="utf-8")
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
VARIES = re.compile(
    r"(?P<uuid>[0-9a-f]{8}-[0-9a-f-]{27}|[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-\.\.\.|\b[0-9a-f]{8}\b)"
    r"|(?P<time>[A-Z][a-z]{2} \d\d \d\d:\d\d:\d\d|\d\d:\d\d:\d\d)"
    r"|(?P<number>\b\d+(?:\.\d+)?(?:%|M| MB)?(?=\s|$))|\x1b[\[(][0-9;?]*[a-zA-Z]|#+\.+"
)
"""What differs each time: it is compared by its kind."""
ERASED = re.compile(r"[^\n]*\r\x1b\[K")
"""A line that a command has written anew, which nobody sees any more."""
KEYS = {"doractl top": ("plot", b"q"), "doractl run": ("frame ", b"\x03")}
"""Commands that wait for a key: when to press it, and which."""
DONE = "typed and ended with status"
PLACE = Path("/srv/robot")
EXAMPLE = Path("/usr/share/doc/dora-systemd/examples/robot")


def by_kind(text: str) -> str:
    """The text as it stays on a terminal, with what varies replaced by the name of its kind."""
    seen = ERASED.sub("", text)
    return VARIES.sub(lambda match: f" <{match.lastgroup}> " if match.lastgroup else "", seen)


def typed_lines() -> Iterator[tuple[str, str]]:
    """Each line that is typed, and what it prints."""
    section = README[README.index("## Five minutes") : README.index("What happened, at three")]
    for block in re.findall(r"^```\n(.*?)^```", section, re.DOTALL | re.MULTILINE):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            line, _, shown = part.partition("\n")
            yield line, shown


@pytest.fixture(scope="module")
def shell() -> Iterator["Shell"]:
    packages.install()
    if not EXAMPLE.exists():
        # The image leaves out /usr/share/doc, as images of containers do.
        shutil.copytree(packages.ROBOT, EXAMPLE)
    # A new machine has no dataflows that have ended.
    sh("journalctl --quiet --rotate && journalctl --quiet --vacuum-time=1us")
    shell = Shell()
    yield shell
    shell.end()
    sh("doractl destroy --force")
    packages.apt("purge", "--yes", *packages.PACKAGES)
    sh(f"rm -rf {PLACE}")


class Shell:
    """A shell on a terminal of 50 rows and 100 columns, as a person has it."""

    def __init__(self) -> None:
        self._ours, theirs = os.openpty()
        termios.tcsetwinsize(theirs, (50, 100))
        command = [*packages.caller("root"), "TERM=xterm", "PS1=", "PS2=", "sh", "-i"]
        own = ["setsid", "--ctty", "--wait", *command]
        self.child = subprocess.Popen(own, stdin=theirs, stdout=theirs, stderr=theirs)
        os.close(theirs)
        self.type("stty -echo; echo ready")
        self.read_until(r"\nready\r\n", 10)

    def type(self, line: str) -> None:
        os.write(self._ours, line.encode() + b"\n")

    def run(self, line: str) -> tuple[str, int]:
        """What a line prints, and its exit status."""
        self.type(f'{line.partition("   #")[0]}; echo "{DONE} $?"')
        key = KEYS.get(line.partition("   #")[0].strip())
        if key:
            self.read_until(key[0], 60, keep=True)
            os.write(self._ours, key[1])
        text = self.read_until(rf"{DONE} \d+\r?\n", 120)
        shown, _, status = text.rpartition(DONE)
        return shown.replace("\r\n", "\n"), int(status)

    def read_until(self, pattern: str, seconds: float, keep: bool = False) -> str:
        """What is shown until `pattern` matches."""
        seen = getattr(self, "_seen", "")
        end = time.monotonic() + bound(seconds)
        while not re.search(pattern, seen, re.DOTALL):
            assert time.monotonic() < end, f"no {pattern} in {seen!r}"
            if select.select([self._ours], [], [], 1)[0]:
                seen += os.read(self._ours, 65536).decode(errors="replace")
        self._seen = seen if keep else ""
        return seen

    def end(self) -> None:
        self.type("exit")
        self.child.wait(bound(30))


def test_it_prints_what_stands_there(shell: Shell) -> None:
    checker = doctest.OutputChecker()
    wrong = []
    for line, expected in typed_lines():
        if "pip install" in line:
            # The lab's machines reach no index; theirs is the same, from the image.
            packages.make_venv(PLACE / ".venv")
            continue
        shown, status = shell.run(line)
        if NO_MEMORY and "memory" in line:
            assert "cgroup controller" in shown
            continue
        if status or not checker.check_output(by_kind(expected), by_kind(shown), FLAGS):
            wrong.append(f"$ {line}\n{shown}(exit status {status})")
        print(f"$ {line}\n{shown}", end="")
    assert not wrong, "\n".join(wrong)

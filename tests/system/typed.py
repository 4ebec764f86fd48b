"""Lines typed into a shell on a terminal, and what they show beside what is expected.

A text of them is as a person would keep it: "$ COMMAND", and below it what the command shows, where
"..." stands for anything (doctest's ELLIPSIS) and "(exit status N)" for a failure.
"""

import doctest
import os
import re
import select
import subprocess
import termios
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from tests.lab.pace import bound

DONE = "typed and ended with status"
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
STATUS = re.compile(r"\(exit status (\d+)\)\s*\Z")
VARIES = re.compile(
    r"(?P<uuid>[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-(?:\.\.\.|[0-9a-f]{12})|\b[0-9a-f]{8}\b)"
    r"|(?P<release>\b\d{8}T\d{6}\b)"
    r"|(?P<date>\b\d{4}-\d\d-\d\d\b)"
    r"|(?P<time>[A-Z][a-z]{2} \d\d \d\d:\d\d:\d\d|\d\d:\d\d:\d\d)"
    r"|(?P<span>\b\d+(?:\.\d+)?(?:ms|s|min)\b)"
    r"|(?P<number>\b\d+(?:\.\d+)?(?:%|K|M| MB)?(?=\s|$))|\.*##+\.*"
)
"""What differs each time: it is compared by its kind."""
LOOKS = re.compile(r"doractl (list|why|logs)\b|systemctl (is-|list-|status)|journalctl\b")
"""Commands that change nothing. They are typed again until they show what is expected."""
LOOK_SECONDS = 20.0
QUOTED = re.compile(r"'[^']*'|\"(?:\\.|[^\"\\])*\"|\\.")
UNSEEN = re.compile(
    r"[^\n]*\r\x1b\[K|\x1b[\[(][0-9;:?]*[a-zA-Z]|\x1b[=>]|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)"
)
"""Output that a terminal does not show: overwritten lines, colours, and control sequences."""


class Typed(NamedTuple):
    """One line, what it shows and its exit status; None for a preparation that nobody compares."""

    line: str
    shown: str | None
    status: int = 0

    def fits(self, shown: str, status: int) -> bool:
        """Whether a command that has shown and ended with that has done what is expected."""
        if self.shown is None:
            return status == 0
        checker = doctest.OutputChecker()
        expected = by_kind(self.shown)
        return status == self.status and checker.check_output(expected, by_kind(shown), FLAGS)


def by_kind(text: str) -> str:
    """The text as it stays on a terminal, with what varies replaced by the name of its kind."""
    return VARIES.sub(
        lambda match: f" <{match.lastgroup}> " if match.lastgroup else "", UNSEEN.sub("", text)
    )


def typed_lines(text: str) -> Iterator[Typed]:
    """The lines in a text: those behind "$ ", and behind "% " the preparations."""
    for part in re.split(r"^(?=[$%] )", text, flags=re.MULTILINE)[1:]:
        line, _, shown = part[2:].partition("\n")
        if part.startswith("%"):
            yield Typed(line, None)
            continue
        failed = STATUS.search(shown)
        yield Typed(line, STATUS.sub("", shown), int(failed[1]) if failed else 0)


def command_of(line: str) -> str:
    """The command in a line, without the comment that follows three blanks."""
    command = line.partition("   #")[0]
    # The shell would take what is typed behind the command for a part of the comment, and wait.
    assert not re.search(r"(?:^|[\s;&|()])#", QUOTED.sub("Q", command)), (
        f"write at least three blanks before #: {line}"
    )
    return command


def as_text(line: str, shown: str, status: int) -> str:
    """One line and what it has shown, as such a text has them."""
    return f"$ {line}\n{UNSEEN.sub('', shown)}" + (f"(exit status {status})\n" if status else "")


class Shell:
    """A shell on a terminal of 50 rows and 100 columns, as a person has it.

    words: the words before "sh", which end with assignments of env(1). keys: by command, those that
    wait for a key: when to press it, and which.
    """

    def __init__(
        self, words: Sequence[str], place: Path, keys: Mapping[str, tuple[str, bytes]] = {}
    ) -> None:
        self._keys = keys
        self._seen = ""
        self._ours, theirs = os.openpty()
        termios.tcsetwinsize(theirs, (50, 100))
        own = ["setsid", "--ctty", "--wait", *words, "TERM=xterm", "PS1=", "PS2=", "sh", "-i"]
        self.child = subprocess.Popen(own, stdin=theirs, stdout=theirs, stderr=theirs)
        os.close(theirs)
        self.type(f"stty -echo; cd {place}; echo ready")
        self.read_until(r"\nready\r\n", 10)

    def type(self, line: str) -> None:
        os.write(self._ours, line.encode() + b"\n")

    def run(self, line: str) -> tuple[str, int]:
        """What a line shows, and its exit status."""
        command = command_of(line)
        self.type(f'{command}; echo "{DONE} $?"')
        if key := self._keys.get(command.strip()):
            self.read_until(key[0], 60, keep=True)
            os.write(self._ours, key[1])
        text = self.read_until(rf"{DONE} \d+\r?\n", 120)
        shown, _, status = text.rpartition(DONE)
        return shown.replace("\r\n", "\n"), int(status)

    def read_until(self, pattern: str, seconds: float, keep: bool = False) -> str:
        """What is shown until `pattern` matches."""
        end = time.monotonic() + bound(seconds)
        while not re.search(pattern, self._seen, re.DOTALL):
            assert time.monotonic() < end, f"no {pattern} in {self._seen!r}"
            if select.select([self._ours], [], [], 1)[0]:
                self._seen += os.read(self._ours, 65536).decode(errors="replace")
        seen, self._seen = self._seen, self._seen if keep else ""
        return seen

    def end(self) -> None:
        self.type("exit")
        self.child.wait(bound(30))
        os.close(self._ours)


def type_line(shell: Shell, typed: Typed) -> tuple[str, int]:
    """What a line shows, and its status; one that only looks is typed until it shows what fits."""
    end = time.monotonic() + bound(LOOK_SECONDS)
    seen = shell.run(typed.line)
    while not typed.fits(*seen) and LOOKS.match(typed.line) and time.monotonic() < end:
        time.sleep(0.5)
        seen = shell.run(typed.line)
    return seen


def replay(shell: Shell, text: str) -> list[str]:
    """Type the lines in a text; those that differ, as they were. All are printed as such a text."""
    wrong = []
    for typed in typed_lines(text):
        seen = type_line(shell, typed)
        told = as_text(typed.line, *seen)
        print(told if typed.shown is not None else f"% {typed.line}\n", end="")
        if not typed.fits(*seen):
            wrong.append(told)
    return wrong

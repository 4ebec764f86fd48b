"""The one error of the lab, and the lines it prints while it works."""

import sys
import time


class LabError(Exception):
    """What could not be done, and what to do about it."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = " ".join(message.split())
        self.hint = hint

    def __str__(self) -> str:
        return f"lab: cannot {self.message}" + (f" (hint: {self.hint})" if self.hint else "")


def say(message: str) -> None:
    """Standard error, because standard output belongs to the command."""
    print(f"lab: {message}", file=sys.stderr, flush=True)


class Stage:
    """`with Stage("Debian packages"):` says what is going on and how long it took."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        self.start = time.monotonic()
        say(f"{self.name} ...")

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            say(f"{self.name}: {time.monotonic() - self.start:.1f} s")

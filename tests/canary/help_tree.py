"""`dora --help` as a tree: every command with its usage, its arguments, options and their values.

The sentences are left out: maintainers improve them all the time. dora-help.txt has the tree of the
dora that the tests are pinned to; `python -m tests.canary.help_tree` prints how that on the PATH
differs, and with --print all of it.
"""

import difflib
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

STORED = Path(__file__).parent / "dora-help.txt"
HIDDEN = (("daemon",), ("coordinator",), ("runtime",))
"""What doractl or dora's daemon runs, and `dora --help` does not show."""
DEEPEST = 4
MOST_COMMANDS = 300
MOST_SECONDS = 20.0
_FLAG = re.compile(r"(?:  -\w|      --\w|  [<\[]\w).*")
_COMMAND = re.compile(r"  ([a-z_][\w-]*)(?:\s{2}.*)?")
_VALUES = re.compile(r"\[(?:env|default|possible values|aliases): [^]]*\]")


def read_tree(dora: str) -> list[str]:
    """The lines of the tree of one program."""
    texts: dict[tuple[str, ...], str] = {}
    level: list[tuple[str, ...]] = [(), *HIDDEN]
    with ThreadPoolExecutor(4) as pool:
        while level:
            texts |= zip(level, pool.map(partial(read_help, dora), level), strict=True)
            assert len(texts) <= MOST_COMMANDS, f"more than {MOST_COMMANDS} commands"
            above = [path for path in level if len(path) < DEEPEST]
            level = [(*path, name) for path in above for name in commands(texts[path])]
    return [line for path in sorted(texts) for line in branch(path, texts[path])]


def branch(path: Sequence[str], text: str) -> Iterator[str]:
    """The lines of one command."""
    yield " ".join(("dora", *path))
    yield from (f"    {line}" for line in facts(text))


def read_help(dora: str, path: Sequence[str]) -> str:
    """What a command prints with --help; its error if it does not know that."""
    env = {name: text for name, text in os.environ.items() if not name.startswith("DORA_")}
    done = subprocess.run(
        [dora, *path, "--help"],
        capture_output=True,
        text=True,
        timeout=MOST_SECONDS,
        check=False,
        env=env,
    )
    return done.stdout or done.stderr


def commands(text: str) -> Iterator[str]:
    """The names below "Commands:"."""
    below = text.partition("\nCommands:\n")[2].partition("\n\n")[0]
    for line in below.splitlines():
        found = _COMMAND.fullmatch(line)
        if found and found[1] != "help":
            yield found[1]


def facts(text: str) -> Iterator[str]:
    """Usage, arguments, options and what values they take."""
    for line in text.splitlines():
        if line.startswith(("Usage:", "error:")):
            yield line
        elif _FLAG.fullmatch(line):
            yield re.sub(r"\s{2,}.*", "", line.strip())
        yield from _VALUES.findall(line)


def differences(dora: str) -> list[str]:
    """What this dora has otherwise than the stored tree, as unified diff."""
    stored = STORED.read_text(encoding="utf-8").splitlines()
    names = (STORED.name, "this dora")
    return [*difflib.unified_diff(stored, read_tree(dora), *names, lineterm="", n=2)]


def main(arguments: Sequence[str]) -> int:
    """Print the differences, or the tree; whether something differs."""
    if "--print" in arguments:
        print("\n".join(read_tree("dora")))
        return 0
    found = differences("dora")
    print("\n".join(found) or "dora --help has the commands and options of the stored tree")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

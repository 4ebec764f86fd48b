"""The real shells, and what their Tab key makes of a line."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import DEVNULL

from tests.system.cells import run

Shell = Callable[[str, Sequence[str]], list[str]]

_BASH = """
. /usr/share/bash-completion/bash_completion
_comp_load doractl 2>/dev/null || _completion_loader doractl || :
COMP_LINE=$1 COMP_POINT=${#1}
read -ra COMP_WORDS <<<"${1//=/ = }"
case $1 in *" ") COMP_WORDS+=("") ;; esac
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_doractl
printf '%s\\n' "${COMPREPLY[@]}"
"""

# A terminal of its own, in which somebody types. What is on the screen is hard to read, so the
# widget writes down the line.
_ZSH = """
# What it has found in its directories: without that it looks for a second, each time.
dump=/var/tmp/zsh-completions-$UID
zmodload zsh/zpty
zpty typed zsh -f -i
zpty -w typed "autoload -Uz compinit && compinit -u -d $dump"
zpty -w typed 'note() { zle complete-word; print -r -- "$BUFFER" >'$2'; exit }'
zpty -w typed "zle -N note; bindkey '^X' note"
zpty -w -n typed "$1"$'\\x18'
while zpty -r typed screen; do :; done
"""

_FISH = "complete --do-complete $argv[1]"


def ask_bash(line: str, caller: Sequence[str]) -> list[str]:
    """What bash offers for the last word of `line`."""
    done = run(*caller, "bash", "--norc", "-c", _BASH, "bash", line)
    return list(filter(None, done.stdout.splitlines()))


def ask_zsh(line: str, caller: Sequence[str]) -> list[str]:
    """The word that zsh makes of the last word of `line`, if only one fits."""
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o777)
        noted = Path(place) / "line"
        run(*caller, "zsh", "-f", "-c", _ZSH, "zsh", line, str(noted))
        completed = noted.read_text().removesuffix("\n")
    return [] if completed == line else [completed.split()[-1]]


def ask_fish(line: str, caller: Sequence[str]) -> list[str]:
    """What fish offers for the last word of `line`."""
    done = run(*caller, "fish", "--command", _FISH, line, stdin=DEVNULL)
    return [one.partition("\t")[0] for one in done.stdout.splitlines()]


SHELLS: dict[str, Shell] = {"bash": ask_bash, "zsh": ask_zsh, "fish": ask_fish}

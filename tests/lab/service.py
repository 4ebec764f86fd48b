"""A command as a service of the booted system, in the same words for both forms."""

import os
from collections.abc import Sequence

from lab.image import CLEAN_PATH
from lab.options import Options

# The shell's own report of a killed command must not be in the command's output; systemd-run
# itself would report SIGTERM as success.
KEEP_STATUS = 'exec 3>&2 2>/dev/null; "$@" 2>&3 3>&-; exit $?'


def service_command(command: Sequence[str], options: Options, terminal: bool) -> list[str]:
    """In a cgroup of the system's, and what it leaves running ends with it."""
    env = {"PATH": CLEAN_PATH, "HOME": "/root", "LANG": "C.UTF-8", "LAB": options.form}
    env |= {"TERM": os.environ.get("TERM", "dumb")} if terminal else {}
    return [
        "env", "SYSTEMD_ADJUST_TERMINAL_TITLE=0", "SYSTEMD_TINT_BACKGROUND=0",
        "systemd-run", "--quiet", "--wait", "--collect", "--pty" if terminal else "--pipe",
        "--unit=lab-command", "--working-directory=/src", "--service-type=exec",
        *(f"--setenv={name}={value}" for name, value in (env | dict(options.env)).items()),
        "--", "/bin/bash", "-c", *map(escape, (KEEP_STATUS, "lab", *command)),
    ]  # fmt: skip


def escape(word: str) -> str:
    """What systemd makes `word` of. --expand-environment=no would be for systemd 254 and newer."""
    return word.replace("$", "$$")

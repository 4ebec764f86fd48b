"""Commands of doractl that are killed before they end, at a time or at a change of the disk."""

import subprocess
import sys
from pathlib import Path

from tests.system.releases import Releases

# The hook is called before each thing that Python does to the disk and to processes.
_HOOK = """
import os, signal, sys
left = int(sys.argv.pop(1))
own = os.getpid()
NAMES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.chmod", "os.chown", "os.link"}
NAMES |= {"os.symlink", "os.truncate", "shutil.rmtree", "subprocess.Popen", "fcntl.flock"}
def hook(event, arguments):
    global left
    is_write = event == "open" and isinstance(arguments[2], int) and arguments[2] & 0o103
    if (event in NAMES or is_write) and os.getpid() == own:
        left -= 1
        if not left:
            {END}
sys.addaudithook(hook)
def leave(status, really=os._exit):
    sys.stderr.write(f"{COUNTED} {-left}\\n")
    sys.stderr.flush()
    really(status)
os._exit = leave
from dora_systemd.cli.main import main
main()
"""
COUNTED = "changes:"
KILL = "os.kill(own, signal.SIGKILL)"


def deploy_words(releases: Releases, place: Path, soak: str = "0s") -> tuple[str, ...]:
    """The words of a deploy for Cell.doractl()."""
    return ("deploy", str(place), "--name", releases.cell.name, "--soak", soak)


def begin(releases: Releases, *words: str, is_group: bool = False) -> "subprocess.Popen[str]":
    """A doractl that goes on. is_group: in a process group of its own."""
    return _popen(("doractl", releases.cell.scope.flag, *words), is_group)


def _popen(command: tuple[str, ...], is_group: bool = False) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0 if is_group else None,
    )


def begin_counted(
    releases: Releases, change: int, *words: str, end: str = KILL
) -> "subprocess.Popen[str]":
    """A doractl that ends itself before this change of the disk; 0: it counts them.

    end: the line of Python that does it.
    """
    hook = _HOOK.replace("{COUNTED}", COUNTED).replace("{END}", end)
    command = (sys.executable, "-c", hook, str(change), releases.cell.scope.flag, *words)
    return _popen(command)

"""Running the tools the lab is made of."""

import os
import shutil
import subprocess
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from lab.errors import LabError

# tool -> the Debian package that has it
TOOLS = {
    "mmdebstrap": "mmdebstrap",
    "systemd-nspawn": "systemd-container",
    "mke2fs": "e2fsprogs",
    "ip": "iproute2",
}


def need_tools(*names: str) -> None:
    missing = [TOOLS[name] for name in names if not shutil.which(name)]
    if missing:
        raise LabError(f"find {names[0]}", f"apt-get install {' '.join(missing)}")


def need_root() -> None:
    if os.geteuid() != 0:
        raise LabError("work without root", "sudo tests/lab/lab ...")


def run_logged(
    command: Sequence[str], log: Path, what: str, env: Mapping[str, str] | None = None
) -> None:
    with log.open("ab") as sink:
        sink.write(f"$ {' '.join(command)}\n".encode())
        sink.flush()
        result = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink, env=env, check=False
        )
    if result.returncode:
        raise LabError(f"{what}: {read_last_line(log)}", f"see {log}")


def read_last_line(log: Path) -> str:
    with log.open(encoding="utf-8", errors="replace") as lines:
        last = deque((line.strip() for line in lines if line.strip()), maxlen=1)
    return last[0] if last else "no output"


def die_with_parent(command: Sequence[str], by: str = "KILL") -> list[str]:
    """The kernel sends it the signal `by` when the lab dies, however the lab dies."""
    return ["setpriv", "--pdeathsig", by, "--", *command]

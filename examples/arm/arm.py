"""Moves the arm towards the target, a step for every tick, and reports to its watchdog.

While the arm is far from its target it holds a lock, so that nobody restarts it in the middle of a
movement. Without dora-systemd, under `dora run`, nobody reads the reports and the lock.
"""

import fcntl
import os
import socket
from pathlib import Path
from typing import TextIO

from dora import Node

STEP, NEAR = 2.0, 8.0


def report(text: str) -> None:
    """Send what sd_notify(3) would."""
    if path := os.environ.get("NOTIFY_SOCKET"):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.sendto(text.encode(), path)


def hold(lock: TextIO, is_moving: bool) -> bool:
    """Whether the arm may move: not while a restart is under way."""
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB if is_moving else fcntl.LOCK_UN)
    except BlockingIOError:
        return False
    return True


def main() -> None:
    node = Node()
    angle = target = 0.0
    with Path(os.environ.get("DORA_INHIBIT_LOCK", os.devnull)).open("a") as lock:
        print(os.getpid(), "the arm moves", file=lock, flush=True)
        for event in node:
            if event["type"] != "INPUT":
                continue
            if event["id"] == "target":
                target = event["value"][0].as_py()
            elif hold(lock, abs(target - angle) > NEAR):
                angle += max(-STEP, min(STEP, target - angle))
            report(f"WATCHDOG=1\nSTATUS=at {angle:.0f} degrees")


if __name__ == "__main__":
    main()

"""What a main process tells its manager and is given by it: sd_notify(3), sd_listen_fds(3)."""

import socket
import time

from systemd.daemon import listen_fds, notify


def send_ready() -> None:
    """READY=1: the start job is done."""
    notify("READY=1")


def send_status(text: str) -> None:
    """STATUS=: one line for `systemctl status`."""
    notify(f"STATUS={' '.join(text.split())}")


def send_reloading() -> None:
    """RELOADING=1: until READY=1 comes again."""
    notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")


def send_stopping() -> None:
    """STOPPING=1: the end has begun."""
    notify("STOPPING=1")


def send_alive() -> None:
    """WATCHDOG=1: see WatchdogSec= in systemd.service(5)."""
    notify("WATCHDOG=1")


def activated_sockets() -> list[socket.socket]:
    """The listening sockets that the manager has passed."""
    return [socket.socket(fileno=number) for number in listen_fds()]

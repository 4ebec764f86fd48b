"""What a main process tells its manager and is given by it: sd_notify(3), sd_listen_fds(3)."""

import os
import socket
import time


def send_ready() -> None:
    """READY=1: the start job is done."""
    _notify("READY=1")


def send_status(text: str) -> None:
    """STATUS=: one line for `systemctl status`."""
    _notify(f"STATUS={' '.join(text.split())}")


def send_reloading() -> None:
    """RELOADING=1: until READY=1 comes again."""
    _notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")


def send_stopping() -> None:
    """STOPPING=1: the end has begun."""
    _notify("STOPPING=1")


def send_alive() -> None:
    """WATCHDOG=1: see WatchdogSec= in systemd.service(5)."""
    _notify("WATCHDOG=1")


def activated_sockets() -> list[socket.socket]:
    """The listening sockets that the manager has passed."""
    from systemd.daemon import listen_fds

    return [socket.socket(fileno=number) for number in listen_fds()]


def _notify(text: str) -> None:
    """Nobody listens where systemd has not started us, and its library may be missing there."""
    if "NOTIFY_SOCKET" in os.environ:
        from systemd.daemon import notify

        notify(text)

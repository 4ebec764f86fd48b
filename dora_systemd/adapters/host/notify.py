"""Messages to the service manager, and sockets from it: sd_notify(3), sd_listen_fds(3)."""

import os
import socket
import time


def send_ready() -> None:
    """READY=1: the start job is complete."""
    _notify("READY=1")


def send_status(text: str) -> None:
    """STATUS=: one line for `systemctl status`."""
    # A file name need not be UTF-8, but this must be.
    clean = text.encode(errors="backslashreplace").decode()
    _notify(f"STATUS={' '.join(clean.split())}")


def send_reloading() -> None:
    """RELOADING=1: until the next READY=1."""
    _notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")


def send_stopping() -> None:
    """STOPPING=1: the shutdown has begun."""
    _notify("STOPPING=1")


def send_alive() -> None:
    """WATCHDOG=1: see WatchdogSec= in systemd.service(5)."""
    _notify("WATCHDOG=1")


def extend_timeout(duration: int) -> None:
    """EXTEND_TIMEOUT_USEC=: a start may take `duration` µs from now on."""
    _notify(f"EXTEND_TIMEOUT_USEC={duration}")


def activated_sockets() -> list[socket.socket]:
    """The listening sockets that the manager has passed."""
    from systemd.daemon import listen_fds

    return [socket.socket(fileno=number) for number in listen_fds()]


def _notify(text: str) -> None:
    """Send a message; without NOTIFY_SOCKET do nothing: systemd's library may be missing."""
    if "NOTIFY_SOCKET" in os.environ:
        from systemd.daemon import notify

        notify(text)

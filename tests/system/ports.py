"""Ports that connections must leave free."""

from pathlib import Path


def reserve_ports() -> None:
    """No connection of a dataflow may happen to take a gateway's port: see ip-sysctl, tcp(7)."""
    Path("/proc/sys/net/ipv4/ip_local_reserved_ports").write_text("53290-53299")

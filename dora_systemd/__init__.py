"""Run dora dataflows as systemd services."""

__version__ = "0.1.0"

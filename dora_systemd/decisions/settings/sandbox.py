"""The settings of the sandbox."""

from collections.abc import Sequence
from typing import Any

from dora_systemd.decisions.properties.sandbox import (
    DEFAULT_LEVEL,
    DEFAULT_NETWORK,
    LEVELS,
    NETWORKS,
)
from dora_systemd.decisions.settings.kinds import PATHS, Kind, Setting, one_text
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import did_you_mean
from dora_systemd.values import quoted


def _choice(what: str, metavar: str, choices: Sequence[str]) -> Kind[str]:
    expected = f"{', '.join(choices[:-1])} or {choices[-1]}"

    def parse(given: str) -> str:
        text = given.strip()
        if text not in choices:
            hint = did_you_mean(text, choices) or f"valid values: {', '.join(choices)}"
            raise DoraSystemdError(f"cannot use {quoted(text)} as {what}", hint, ExitCode.USAGE)
        return text

    return one_text(str, expected, metavar, parse)


SANDBOX = Setting[str](
    "sandbox",
    _choice("sandbox", "LEVEL", LEVELS),
    DEFAULT_LEVEL,
    "Sandbox level: none, default or strict.",
)
WRITABLE = Setting[tuple[str, ...]](
    "writable",
    PATHS,
    (),
    "Directory or file that the nodes may write to despite the sandbox.",
    metavar="PATH",
)
NETWORK = Setting[str](
    "network",
    _choice("network", "REACH", NETWORKS),
    DEFAULT_NETWORK,
    "Network of the nodes: host, loopback (the host's loopback only) or private (one of its own).",
)
SANDBOX_SETTINGS: tuple[Setting[Any], ...] = (SANDBOX, WRITABLE, NETWORK)

"""The settings of the sandbox."""

from collections.abc import Sequence
from typing import Any

from dora_systemd.decisions.properties.sandbox import (
    DEFAULT_LEVEL,
    DEFAULT_NETWORK,
    LEVELS,
    NETWORKS,
)
from dora_systemd.decisions.settings.kinds import PATHS, Base, Kind, Setting, scalar_text
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.suggestions import did_you_mean
from dora_systemd.values import quoted


def _choice(what: str, choices: Sequence[str]) -> Kind[str]:
    expected = f"{', '.join(choices[:-1])} or {choices[-1]}"

    def parse(value: Any, base: Base) -> str:
        del base
        text = scalar_text(value).strip()
        if text not in choices:
            hint = did_you_mean(text, choices) or f"valid values: {', '.join(choices)}"
            raise DoraSystemdError(f"cannot use {quoted(text)} as {what}", hint, ExitCode.USAGE)
        return text

    return Kind[str](str, expected, parse, lambda value: [value])


SANDBOX = Setting[str](
    "sandbox",
    _choice("sandbox", LEVELS),
    DEFAULT_LEVEL,
    "Sandbox level: none, default or strict.",
    flags=("--sandbox",),
    variable="DORA_SANDBOX",
    metavar="LEVEL",
)
WRITABLE = Setting[tuple[str, ...]](
    "writable",
    PATHS,
    (),
    "Directory or file that the nodes may write to despite the sandbox.",
    flags=("--writable",),
    metavar="PATH",
)
NETWORK = Setting[str](
    "network",
    _choice("network", NETWORKS),
    DEFAULT_NETWORK,
    "Network of the nodes: host, loopback (the host's loopback only) or private (one of its own).",
    flags=("--network",),
    variable="DORA_NETWORK",
    metavar="REACH",
)
SANDBOX_SETTINGS: tuple[Setting[Any], ...] = (SANDBOX, WRITABLE, NETWORK)

"""The settings of the sandbox; names and files of the nodes' credentials, see systemd.exec(5)."""

import re
from collections.abc import Mapping, Sequence
from operator import or_
from typing import Any

from dora_systemd.decisions.properties.assignments import typed
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.sandbox import (
    DEFAULT_LEVEL,
    DEFAULT_NETWORK,
    LEVELS,
    NETWORKS,
)
from dora_systemd.decisions.settings.kinds import (
    PATH,
    PATHS,
    Base,
    Kind,
    Setting,
    one_text,
    texts_of,
)
from dora_systemd.errors import usage_error
from dora_systemd.names import did_you_mean
from dora_systemd.values import quoted, scalar_text

MOST_OF_CREDENTIALS = 1024 * 1024
"""Maximum bytes of all credentials of a unit together; the limit of systemd."""

_NAME = r"(?!\.{1,2}\Z)[!-.0-9;-~]{1,255}"


def parse_credentials(value: Any, base: Base) -> Mapping[str, str]:
    """Files by name, from a mapping or from texts NAME=FILE. Raises DoraSystemdError (USAGE)."""
    if isinstance(value, Mapping):
        return dict(_pair(scalar_text(name), file, base) for name, file in value.items())
    return dict(_parse_one(one, base) for one in texts_of(value))


def credential_properties(files: Mapping[str, str]) -> dict[str, Property]:
    """LoadCredential= of systemd.exec(5). files: absolute path by name."""
    return typed(LoadCredential=tuple(files.items())) if files else {}


def _parse_one(text: str, base: Base) -> tuple[str, str]:
    name, equals, file = text.partition("=")
    if not equals:
        hint = "write NAME=FILE, such as token=/etc/robot/token"
        raise usage_error(f"cannot set credential {quoted(text)}", hint)
    return _pair(name, file, base)


def _pair(name: str, file: Any, base: Base) -> tuple[str, str]:
    if not re.fullmatch(_NAME, name):
        hint = "a name is ASCII without blanks, '/' and ':', as that of a file"
        raise usage_error(f"cannot name a credential {quoted(name)}", hint)
    path = PATH.parse(file, base)
    if path.endswith("\\"):
        # In a unit file the backslash would continue the line.
        raise usage_error(f"cannot use {quoted(path)} as credential", "give the file another name")
    return name, path


CREDENTIALS = Setting[Mapping[str, str]](
    "credentials",
    Kind[Mapping[str, str]](
        dict[str, str] | list[str],
        "a mapping, NAME: FILE",
        parse_credentials,
        lambda value: [f"{name}={file}" for name, file in value.items()],
        is_repeatable=True,
        merge=or_,
    ),
    {},
    "Secret that the nodes read as the file NAME in $CREDENTIALS_DIRECTORY.",
    flags=("--credential",),
    metavar="NAME=FILE",
    root_only=True,
)
CREDENTIAL_SETTINGS = (CREDENTIALS,)


def _choice(what: str, metavar: str, choices: Sequence[str]) -> Kind[str]:
    expected = f"{', '.join(choices[:-1])} or {choices[-1]}"

    def parse(given: str) -> str:
        text = given.strip()
        if text not in choices:
            hint = did_you_mean(text, choices) or f"valid values: {', '.join(choices)}"
            raise usage_error(f"cannot use {quoted(text)} as {what}", hint)
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

"""Credentials of the nodes: names and files for LoadCredential=, see systemd.exec(5)."""

import re
from collections.abc import Mapping
from operator import or_
from typing import Any

from dora_systemd.decisions.properties.assignments import typed
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.settings.kinds import PATH, Base, Kind, Setting, texts_of
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted, scalar_text

MAX_SIZE = 1024 * 1024
"""Maximum bytes of all credentials of a unit together; the limit of systemd."""

_NAME = re.compile(r"(?!\.{1,2}\Z)[!-.0-9;-~]{1,255}")


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
        raise DoraSystemdError(f"cannot set credential {quoted(text)}", hint, ExitCode.USAGE)
    return _pair(name, file, base)


def _pair(name: str, file: Any, base: Base) -> tuple[str, str]:
    if not _NAME.fullmatch(name):
        hint = "a name is ASCII without blanks, '/' and ':', as that of a file"
        raise DoraSystemdError(f"cannot name a credential {quoted(name)}", hint, ExitCode.USAGE)
    path = PATH.parse(file, base)
    if path.endswith("\\"):
        # In a unit file the backslash would continue the line.
        hint = "give the file another name"
        raise DoraSystemdError(f"cannot use {quoted(path)} as credential", hint, ExitCode.USAGE)
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

"""Persistent unit files: their text, and whether they are ours.

The text is that of systemd.unit(5), made from `properties` or from the files that systemd itself
wrote for a transient unit: both are equivalent for the same dataflow.
"""

import posixpath
import re
from collections.abc import Mapping, Sequence

from dora_systemd.decisions.cell.options import (
    RunnerOptions,
    known_options_from_command,
    options_from_command,
)
from dora_systemd.decisions.properties.assignments import (
    format_property,
    parse_line,
    typed,
    with_properties,
)
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.structs import MS_REC
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import unit_name

BOOT_TARGET = "dora.target"
"""Starts the enabled dataflows at boot, if it is installed; no other unit waits for it."""

BOOT_CHECK = "boot-complete.target"
"""Reached when a boot is good, see systemd-bless-boot.service(8)."""

HEADER = "# Written by doractl(1). To change something: systemctl edit, see dora-systemd(7).\n"

_SECTION = r"\[([^\]]+)\]"
_BLANKS = " \t\r"
_COMMAND = r"ExecStart\s*=\s*\S"
_COMMENT = rf"(?m)^[{_BLANKS}]*[#;].*\n?"
_CONTINUED = rf"\\[{_BLANKS}]*(?:\n[{_BLANKS}]*|\Z)"
_SPECIFIER = r"%[a-zA-Z]"
_BOOT_CHECK_ORDER = f"Before={BOOT_CHECK}"
_ORDERS = ("After=default.target", "After=multi-user.target", _BOOT_CHECK_ORDER)
_MOUNTABLE = r"[^\x00-\x1f\x7f\"'\\]+"
_TRANSIENT = "# This is a transient unit file"
# A bind mount as systemd 257 writes it into such a file. systemd quotes nothing there, and would
# itself read other paths from a line with blanks.
_TRANSIENT_BIND = r"(Bind(?:ReadOnly)?Paths)=(-?)(/[^:]*):(/[^:]*):(rbind|norbind)"


def format_sections(sections: Mapping[str, Sequence[str]]) -> str:
    """The text of a unit file, from its lines by section."""
    parts = ["\n".join((f"[{name}]", *lines)) for name, lines in sections.items() if lines]
    return "\n\n".join(parts) + "\n"


def plain_target(is_user: bool) -> str:
    """The target that every boot (or start of a user's manager) reaches."""
    return "default.target" if is_user else "multi-user.target"


def persistent_unit(
    texts: Sequence[str],
    options: RunnerOptions,
    is_user: bool,
    target: str,
    is_checked: bool = False,
) -> str:
    """Format one unit file equivalent to `texts` (a fragment and its drop-ins), wanted by `target`.

    A plain target does not wait for the dataflow: the dataflow starts after it. is_checked: a boot
    is good only if the dataflow comes up.
    """
    sections = _sections(texts)
    unit = sections.setdefault("Unit", [])
    boot = [] if target == BOOT_TARGET else [f"After={target}"]
    boot += [] if is_user else _mounts(options)
    boot += [_BOOT_CHECK_ORDER] if is_checked else []
    unit += [line for line in boot if line not in unit]
    sections["Install"] = [f"WantedBy={target}"]
    sections["Install"] += [f"RequiredBy={BOOT_CHECK}"] if is_checked else []
    return HEADER + format_sections(sections)


def without_install(text: str) -> str:
    """The unit file without its [Install] section, and without what a boot check adds."""
    sections = _sections([text])
    sections["Unit"] = [line for line in sections["Unit"] if line != _BOOT_CHECK_ORDER]
    return HEADER + format_sections(sections)


def is_without_install(text: str, unit: str) -> bool:
    """Whether it is what without_install() has made of the unit file of this unit."""
    options = runner_of(text)
    is_own = options is not None and unit_name(options.name) == unit
    return is_own and text.startswith(HEADER) and "\n[Install]\n" not in text


def with_boot_check(text: str) -> str:
    """The unit file with what a boot check adds."""
    sections = _sections([text])
    for name, line in (("Unit", _BOOT_CHECK_ORDER), ("Install", f"RequiredBy={BOOT_CHECK}")):
        lines = sections.setdefault(name, [])
        lines += [] if line in lines else [line]
    return HEADER + format_sections(sections)


def is_boot_checked(text: str) -> bool:
    """Whether a boot is good only if the dataflow of this unit file comes up."""
    return f"RequiredBy={BOOT_CHECK}" in _logical_lines(text)


def runner_of(text: str, can_start: bool = False) -> RunnerOptions | None:
    """The runner's options in the unit file `text`; None if it is not one of ours.

    can_start: None also for a file with options that this version does not know.
    """
    try:
        command = _command_of(text)
        return (options_from_command if can_start else known_options_from_command)(command)
    except (DoraSystemdError, ValueError):
        return None


def program_of(text: str) -> str:
    """The Python interpreter in a unit file of ours, which runner_of() accepts."""
    return _command_of(text)[0]


def _command_of(text: str) -> list[str]:
    """The only command of ExecStart= in a unit file. Raises DoraSystemdError, ValueError."""
    lines = _sections([text]).get("Service", ())
    (command,) = (line.partition("=")[2] for line in lines if re.match(_COMMAND, line))
    ((_, argv, _),) = parse_line("ExecStart", command)["ExecStart"].value
    return [word.replace("%%", "%") for word in argv]


def user_of(text: str) -> str:
    """Read User= of a unit file, "" if it has none."""
    values = [line.removeprefix("User=") for line in _logical_lines(text) if line[:5] == "User="]
    return values[-1] if values else ""


def says_the_same(text: str, other: str) -> bool:
    """Return whether two unit files start a dataflow in the same way, by any target.

    False also if one of them has lines that doractl does not write.
    """
    first = _properties(text)
    return first is not None and first == _properties(other)


def _properties(text: str) -> dict[str, Property] | None:
    sections = _sections([text])
    properties: dict[str, Property] = {}
    for line in (line for lines in sections.values() for line in lines):
        key, _, value = line.partition("=")
        if line in _ORDERS:
            continue
        if re.search(_SPECIFIER, value.replace("%%", "")):
            return None
        try:
            change = parse_line(key, value.replace("%%", "%"))
        except (KeyError, DoraSystemdError):
            return None
        properties = with_properties(properties, change)
    return {slot: _ordered(one) for slot, one in properties.items()}


def _ordered(one: Property) -> Property:
    """The property with sorted networks, because systemd keeps them as a set."""
    return one._replace(value=tuple(sorted(one.value))) if one.signature == "a(iayu)" else one


def _mounts(options: RunnerOptions) -> list[str]:
    """RequiresMountsFor= for the paths of the dataflow, without those that the line cannot contain.

    systemd.unit(5) supports quotes there, but no escapes.
    """
    paths = (posixpath.dirname(options.dataflow), options.working_directory)
    clean = dict.fromkeys(posixpath.normpath(path).replace("%", "%%") for path in paths)
    words = [
        f'"{path}"' if " " in path else path for path in clean if re.fullmatch(_MOUNTABLE, path)
    ]
    return [f"RequiresMountsFor={' '.join(words)}"] if words else []


def _sections(texts: Sequence[str]) -> dict[str, list[str]]:
    """The lines of all texts by section, without comments and lines that belong to another file."""
    sections: dict[str, list[str]] = {"Unit": [], "Service": []}
    for text in texts:
        name = ""
        for line in _logical_lines(text):
            heading = re.fullmatch(_SECTION, line)
            if heading:
                name = heading[1]
            elif name and name != "Install":
                quoted = _quoted_bind(line) if text.startswith(_TRANSIENT) else line
                sections.setdefault(name, []).append(quoted)
    return sections


def _quoted_bind(line: str) -> str:
    """The bind mount of a transient unit, quoted so that systemd reads the same paths again."""
    found = re.fullmatch(_TRANSIENT_BIND, line.replace("%%", "%"))
    if not found:
        return line
    key, optional, source, target, option = found.groups()
    bind = (source, target, bool(optional), MS_REC if option == "rbind" else 0)
    (quoted,) = format_property(key, typed(**{key: (bind,)}))
    return quoted


def _logical_lines(text: str) -> list[str]:
    """Lines without comments; a backslash at the end joins the next line."""
    joined = re.sub(_CONTINUED, " ", re.sub(_COMMENT, "", text))
    # Not splitlines(): only a newline ends a line here.
    return [line for raw in joined.split("\n") if (line := raw.strip(_BLANKS))]

"""Variables in values of `env:`, such as ${HOME}, which the dora command replaces in its own way.

The dora command replaces variables when it reads the file. Of a supervised dataflow dora reads the
descriptor in the unit, which has another environment. So doractl passes the caller's values to the
runner. The runner replaces the variables and escapes the result, because dora's coordinator and
dora's daemon each replace variables again (measured with dora 1.1).
"""

import re
from collections.abc import Iterator, Mapping

from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.json_size import is_infinite

_NAME = "[A-Za-z_][A-Za-z0-9_]*"
_SHORT = rf"\$\$|\$(?P<plain>{_NAME})"
_LONG = rf"\$\{{(?P<name>{_NAME})(?::-(?P<default>[^}}]*))?\}}"
_REFERENCE = re.compile(f"{_SHORT}|{_LONG}")
_WITHOUT_BRACE = re.compile(_SHORT)

_DOLLAR = "$$$$"
"""A "$" that coordinator and daemon have both halved."""

_UNTIL_DAEMON = "$${DORA_SYSTEMD_NUMBER:-%s}"
"""A text that only the daemon reads as a number. dora makes a float of "inf" and "nan". If the
coordinator did, its JSON could not hold it, and the daemon would never answer."""

_OF_THE_UNIT = {
    *("HOME", "USER", "LOGNAME", "SHELL", "PATH", "PWD", "VIRTUAL_ENV", "TMPDIR"),
    *("XDG_RUNTIME_DIR", "INVOCATION_ID", "JOURNAL_STREAM", "NOTIFY_SOCKET", "RUNTIME_DIRECTORY"),
}
"""Variables that systemd sets or that describe the nodes' user, see systemd.exec(5)."""


_ALWAYS = "RUST_LOG"
"""The level of dora's own log, and of nodes in Rust: dora passes it on from the caller as well."""


def called_variables(dataflow: Dataflow, caller: Mapping[str, str]) -> dict[str, str]:
    """RUST_LOG and the variables of the caller that values of `env:` name, except the unit's."""
    named = dict.fromkeys(name for text in _texts(dataflow) for name in _names(text))
    named |= {_ALWAYS: None}
    return {name: caller[name] for name in named if name in caller and name not in _OF_THE_UNIT}


def expanded(env: Mapping[str, object], environment: Mapping[str, str]) -> dict[str, object]:
    """The values of `env:` as they must be sent, so that nodes get what `dora run` gives them.

    A variable that is not set stays, for dora to report.
    """

    def replaced(match: re.Match[str]) -> str:
        found = match.groupdict()
        name: str | None = found["plain"] or found.get("name")
        value: str | None = environment.get(name, found.get("default")) if name else "$"
        return match[0] if value is None else value.replace("$", _DOLLAR)

    def replaced_in(text: str) -> str:
        whole, rest = _parts(text)
        return _REFERENCE.sub(replaced, whole) + _WITHOUT_BRACE.sub(replaced, rest)

    return {
        key: _until_daemon(replaced_in(value)) if isinstance(value, str) else value
        for key, value in env.items()
    }


def unset_variables(dataflow: Dataflow, environment: Mapping[str, str]) -> list[str]:
    """Return the variables that values of `env:` name, and that nothing gives a value."""
    names = (name for text in _texts(dataflow) for name in _names(text, with_default=False))
    return [name for name in dict.fromkeys(names) if name not in environment]


def _until_daemon(text: str) -> str:
    return _UNTIL_DAEMON % text if is_infinite(text) else text


def _texts(dataflow: Dataflow) -> Iterator[str]:
    for env in (dataflow.env, *(node.env for node in dataflow.nodes)):
        yield from (value for value in env.values() if isinstance(value, str))


def _names(text: str, with_default: bool = True) -> Iterator[str]:
    whole, rest = _parts(text)
    for match in (*_REFERENCE.finditer(whole), *_WITHOUT_BRACE.finditer(rest)):
        found = match.groupdict()
        name = found["plain"] or found.get("name")
        if name and (with_default or found.get("default") is None):
            yield name


def _parts(text: str) -> tuple[str, str]:
    """Split a text after its last "}": in the rest, "${" has no end."""
    head, brace, rest = text.rpartition("}")
    return head + brace, rest

"""Checks the setting on_failure before a start: its program, or the unit that it names."""

import os
import pwd
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.notice.command import Words, is_command, unit_of, words_of
from dora_systemd.errors import bad_input
from dora_systemd.names import notice_unit
from dora_systemd.scope import Scope
from dora_systemd.trust.sight import Sight
from dora_systemd.values import quoted
from dora_systemd.verbs.start.programs import check_program


def find_command(
    words: Words, sight: Sight, user: pwd.struct_passwd | None, search_path: str
) -> Words:
    """The words with the absolute path of the program, as the user of the nodes finds it.

    Raises DoraSystemdError for a program that this user cannot execute.
    """
    if not is_command(words):
        return words
    path = words[0]
    if "/" in path:
        path = str(Path(path).absolute())
        check_program(path, sight, user)
        return (path, *words[1:])
    places = (f"{one}/{path}" for one in search_path.split(os.pathsep) if one.startswith("/"))
    found = next(filter(sight.is_program, places), "")
    if not found:
        message = f"cannot use {quoted(path)} as on_failure: no such program on PATH"
        raise bad_input(message, "install it, or write its path")
    return (found, *words[1:])


def check_units(manager: Manager, scope: Scope, options: RunnerOptions) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if systemd does not know a unit that a notice needs."""
    if not options.is_noticed:
        return
    hint = f"install it: doractl {scope.flag} setup"
    key = "on_failure" if options.has("on_failure") else "black_box"
    _check_unit(manager, notice_unit(options.name), hint, key)
    if unit := unit_of(words_of(options), options.name):
        _check_unit(manager, unit, "see systemctl list-unit-files")


def _check_unit(manager: Manager, unit: str, hint: str, key: str = "on_failure") -> None:
    state = str(manager.read(unit, ["LoadState"])["LoadState"])
    if state != "loaded":
        raise bad_input(f"cannot use {key}: unit {unit} is {state}", hint)

"""`--force` and `--wait` of the verbs that a lock inhibits."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

from dora_systemd.cli.parameters import tell
from dora_systemd.errors import usage_error
from dora_systemd.verbs.facts.locks import IfInhibited

C = TypeVar("C", bound=Callable[..., Any])


def inhibit_options(command: C, or_else: str = "") -> C:
    """Add the options `force` and `wait`, see if_inhibited().

    or_else: what else --force overrides, for --help.
    """
    text = f"Do it even if a lock inhibits it{or_else}."
    force = click.option("--force", is_flag=True, help=text)
    wait = click.option("--wait", is_flag=True, help="Wait while a lock inhibits it.")
    return force(wait(command))


def if_inhibited(force: bool, wait: bool) -> IfInhibited:
    """Return the choice of the two options. Raises DoraSystemdError (USAGE) for both."""
    if force and wait:
        raise usage_error("cannot use --force with --wait", "give one of them")
    if force:
        return IfInhibited.FORCE
    return IfInhibited.WAIT if wait else IfInhibited.REFUSE


class TellWaiting:
    """Prints what a command waits for, each text once."""

    def __init__(self) -> None:
        self._told = ""

    def __call__(self, text: str) -> None:
        if text != self._told:
            tell(f"doractl: {text}", err=True)
        self._told = text

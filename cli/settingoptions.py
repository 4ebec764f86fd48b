"""The options of `start` and `run`: one for each setting with a flag, from the settings table."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import click

from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.limits import LIVE_SETTINGS
from dora_systemd.decisions.settings.table import SETTINGS

F = TypeVar("F", bound=Callable[..., Any])


def setting_options(function: F) -> F:
    """All flags of settings. Their raw values become keyword arguments with the setting's name."""
    return _options(SETTINGS, function)


def live_options(function: F) -> F:
    """The flags of settings that can be changed while a dataflow is running."""
    return _options(LIVE_SETTINGS, function)


def _options(settings: Sequence[Setting[Any]], function: F) -> F:
    for setting in reversed(settings):
        if setting.flags:
            function = _option(setting)(function)
    return function


def _option(setting: Setting[Any]) -> Callable[[F], F]:
    flags = setting.flags
    if setting.kind.is_flag:
        long = flags[0].removeprefix("--")
        spelled = (f"--{long}/--no-{long}", *flags[1:])
        return click.option(*spelled, setting.name, default=None, help=setting.help)
    return click.option(
        *flags,
        setting.name,
        metavar=setting.metavar or "TEXT",
        multiple=setting.kind.is_repeatable,
        default=None,
        help=setting.help,
    )

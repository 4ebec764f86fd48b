"""The options of `start` and `run`: one for each setting with a flag, from the settings table."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import click

from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.table import CHANGEABLE, SECTIONS, SETTINGS

F = TypeVar("F", bound=Callable[..., Any])

_SECTION_OF = {setting.name: title for title, table in SECTIONS.items() for setting in table}


class SettingsCommand(click.Command):
    """A verb whose --help shows its own options first, then those of settings by concern."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the command line; `--flag=false` is `--no-flag`, as dora writes it."""
        known: dict[str, str] = {}
        for parameter in self.get_params(ctx):
            for on, off in zip(parameter.opts, parameter.secondary_opts, strict=False):
                known |= {f"{on}=true": on, f"{on}=false": off}
        return super().parse_args(ctx, [known.get(word, word) for word in args])

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of options."""
        sections: dict[str, list[tuple[str, str]]] = {title: [] for title in ("Options", *SECTIONS)}
        for parameter in self.get_params(ctx):
            if isinstance(parameter, click.Option) and (record := parameter.get_help_record(ctx)):
                title = _SECTION_OF.get(parameter.name or "", "Options")
                sections[title].append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def setting_options(function: F) -> F:
    """All flags of settings. Their raw values become keyword arguments with the setting's name."""
    return _options(SETTINGS, function)


def live_options(function: F) -> F:
    """The flags of settings that can be changed while a dataflow is running."""
    return _options(CHANGEABLE, function)


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
        help=_help(setting),
    )


def _help(setting: Setting[Any]) -> str:
    """The help text with the default, if there is one."""
    if setting.default is None or "default" in setting.help:
        return setting.help
    default = " ".join(setting.kind.format(setting.default))
    return f"{setting.help.removesuffix('.')}; default: {default}." if default else setting.help

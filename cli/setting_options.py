"""The options of `start` and `run`: one for each setting with a flag, and their short --help."""

from collections.abc import Callable, Sequence
from copy import copy
from inspect import cleandoc
from typing import Any, TypeVar

import click

from dora_systemd.cli.parameters import HELP_ALL, wants_all
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.table import SECTIONS, SETTINGS

F = TypeVar("F", bound=Callable[..., Any])

_SECTION_OF = {setting.name: title for title, table in SECTIONS.items() for setting in table}


_EXAMPLES = 5


class SettingsCommand(click.Command):
    """A verb with many options: --help shows the usual ones in one screen, --help=all the others.

    usual: the usual options; empty if --help always shows all. All are shown by concern: first
    those of the verb, then those of settings.
    """

    def __init__(self, *args: Any, usual: Sequence[str] = (), **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._usual = usual

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the command line; `--flag=false` is `--no-flag`, as dora writes it."""
        known: dict[str, str] = {}
        for parameter in self.get_params(ctx):
            for on, off in zip(parameter.opts, parameter.secondary_opts, strict=False):
                known |= {f"{on}=true": on, f"{on}=false": off}
        return super().parse_args(ctx, [known.get(word, word) for word in args])

    def format_help(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write all of it, or of text and examples the beginning."""
        shown = self._shortened() if self._is_short(ctx) else self
        super(SettingsCommand, shown).format_help(ctx, formatter)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the usual options, or all by concern."""
        if self._is_short(ctx):
            self._format_usual(ctx, formatter)
        else:
            self._format_all(ctx, formatter)

    def _is_short(self, ctx: click.Context) -> bool:
        return bool(self._usual) and not wants_all(ctx)

    def _shortened(self) -> "SettingsCommand":
        """A copy with the first paragraph and the first examples, below their heading."""
        short = copy(self)
        short.help = cleandoc(self.help or "").partition("\n\n")[0]
        short.epilog = "\n".join((self.epilog or "").splitlines()[: 2 + _EXAMPLES])
        return short

    def _records(self, ctx: click.Context) -> list[tuple[click.Option, tuple[str, str]]]:
        return [
            (parameter, record)
            for parameter in self.get_params(ctx)
            if isinstance(parameter, click.Option) and (record := parameter.get_help_record(ctx))
        ]

    def _format_usual(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        of = {option.opts[0]: record for option, record in self._records(ctx)}
        # Only the part of a help text before the first semicolon; --help=all has the rest.
        rows = [
            (of[flag][0].split(" / ")[0], f"{of[flag][1].split('; ')[0].rstrip('.')}.")
            for flag in self._usual
        ]
        with formatter.section("Usual options"):
            formatter.write_dl([*rows, (HELP_ALL, f"Show all {len(of)} options.")])

    def _format_all(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        sections: dict[str, list[tuple[str, str]]] = {title: [] for title in ("Options", *SECTIONS)}
        for option, record in self._records(ctx):
            sections[_SECTION_OF.get(option.name or "", "Options")].append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def setting_options(function: F) -> F:
    """Add all flags of settings, whose raw values become arguments with the setting's name."""
    return options_of(SETTINGS, function)


def options_of(settings: Sequence[Setting[Any]], function: F) -> F:
    """The flags of these settings; see setting_options()."""
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

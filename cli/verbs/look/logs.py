"""Print what the nodes of a dataflow wrote."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import click

from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.cli.parameters import current_scope, print_warnings, scope_options
from dora_systemd.cli.terminal import is_dumb, wants_colors
from dora_systemd.decisions.logs.query import ALL_LINES, OUTPUTS, LogQuery, is_boot, parse_level
from dora_systemd.decisions.logs.records import parse_filter
from dora_systemd.decisions.logs.terminal import ShownLines, TerminalLines
from dora_systemd.errors import ExitCode, usage_error
from dora_systemd.names import LINK_PREFIX
from dora_systemd.scope import Scope
from dora_systemd.trust.programs import check_program
from dora_systemd.values import quoted
from dora_systemd.verbs.facts.recorded import find_query, find_soon
from dora_systemd.verbs.logs import has_unit, pass_logs, read_logs, unit_places, write_whole

Lines = TerminalLines | ShownLines | None
"""Formats lines for a terminal; None for a pipe."""

_BOOT_OPTION = "-[afqr]*b|--boot"
_COUNT = "[0-9]+"
_LEFT_OUT = "some messages have control characters; --all prints them, too"


class LogsCommand(click.Command):
    """Takes `-b` without a value, as journalctl does: only a boot can be its value."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        words: list[str] = []
        for word in [*args, ""]:
            if words and re.fullmatch(_BOOT_OPTION, words[-1]):
                words[-1] += "=" if words[-1] == "--boot" else ""
                words[-1] += word if is_boot(word) else "0"
                if is_boot(word):
                    continue
            words.append(word)
        return super().parse_args(ctx, words[:-1])


@click.command("logs", cls=LogsCommand)
@click.argument("selectors", nargs=-1, metavar="[SELECTOR]...")
@click.option(
    "--node",
    "nodes",
    multiple=True,
    metavar="NODE",
    help="Only this node; shell patterns are allowed, may be repeated.",
)
@click.option(
    "--all-nodes", is_flag=True, hidden=True, help="All nodes: the default, accepted as by dora."
)
@click.option(
    "-f",
    "--follow",
    "is_follow",
    is_flag=True,
    help="Wait for new lines; starts with the last 10 unless --lines or --since is given.",
)
@click.option(
    "--until-end",
    is_flag=True,
    help="Follow until the dataflow has ended; keeps following across restarts.",
)
@click.option(
    "-n",
    "--lines",
    "--tail",
    "counts",
    multiple=True,
    metavar="N",
    help="Only the last N lines, or all.",
)
@click.option(
    "-b",
    "--boot",
    default="",
    metavar="[ID]",
    help="Only this boot, or the boot ID: -1 is the one before, see journalctl.",
)
@click.option(
    "--since",
    default="",
    metavar="TIME",
    help='From this time on: "10 min ago", "2026-11-20 18:00", 5m, see systemd.time(7).',
)
@click.option("--until", default="", metavar="TIME", help="Up to this time.")
@click.option(
    "--level",
    default="",
    metavar="LEVEL",
    help="This level and above: error, warn, info, debug, trace, stdout (all).",
)
@click.option(
    "--log-filter",
    default="",
    metavar="FILTER",
    help='Another --level for some nodes, as in dora: "camera=debug,detector=warn".',
)
@click.option(
    "-g",
    "--grep",
    default="",
    metavar="PATTERN",
    help="Only messages that match; case matters if PATTERN has capitals.",
)
@click.option(
    "--run",
    default="ALL",
    show_default=True,
    metavar="RUN",
    help="CURRENT or 0, PREVIOUS or -1, -2 ..., ALL or the id of a run (DORA_RUN).",
)
@click.option(
    "--events", "is_events", is_flag=True, help="Only what happened to the dataflow and its nodes."
)
@click.option("-r", "--reverse", "is_reverse", is_flag=True, help="Newest lines first.")
@click.option("-q", "--quiet", "is_quiet", is_flag=True, help="Print lines only, no notes.")
@click.option(
    "-a",
    "--all",
    "want_unprintable",
    is_flag=True,
    help="In a pipe, print messages with control characters unchanged; a terminal shows them.",
)
@click.option(
    "-o",
    "--output",
    type=click.Choice(OUTPUTS),
    default="short",
    show_default=True,
    help="Output format, as in journalctl.",
)
@click.option(
    "--machine",
    default="",
    metavar="MACHINE",
    help="Only this one of several machines; head is the one with the coordinator.",
)
@click.option("--no-pager", is_flag=True, help="Do not use a pager.")
@scope_options
def command(
    selectors: tuple[str, ...],
    nodes: tuple[str, ...],
    run: str,
    no_pager: bool,
    until_end: bool,
    counts: tuple[str, ...],
    log_filter: str,
    machine: str,
    **options: Any,
) -> int:
    """Print what the nodes of dataflows wrote, and what happened to them.

    Without SELECTOR: the logs of all dataflows. SELECTOR may be a shell pattern. A dataflow may
    have ended long ago. On a terminal, a line that repeats is shown once.

    Examples:
      doractl logs robot                      all there is, in a pager
      doractl logs robot --node camera -f     what one node writes, from now on
      doractl logs robot --until-end -o json  all until it ends, for a program
      doractl logs robot -n 100 --level warn  the last 100 warnings and errors
      doractl logs 'cam*' robot -b            several dataflows, since the boot
      doractl logs robot --run -1 --events    what happened to the run before
      journalctl -t robot/camera              the same, with systemd's own tool
    """
    _require_end(options["until"], options["is_follow"] and not until_end)
    scope = current_scope()
    is_shared = len(selectors) == 1 and has_unit(unit_places(scope, os.environ), LINK_PREFIX)
    if (machine or is_shared) and (status := _print_machines(scope)) is not None:
        return status
    options.pop("all_nodes")
    options["level"] = parse_level(options["level"]) if options["level"] else ""
    check_readable(scope)
    journal = JournalReader()
    wanted = LogQuery(scope, tail=last_count(counts), levels=parse_filter(log_filter), **options)
    query = find_soon(
        lambda: find_query(JournalReader(), wanted, selectors, nodes, run), scope, selectors
    )
    lines = _lines(journal, query)
    if until_end:
        # Imported late: only --until-end needs it.
        from dora_systemd.verbs.follow import check_until_end, follow_to_end

        check_until_end(query)
        return _exit_status(follow_to_end(query, lambda step: _print(step, lines)))
    is_paged = not (no_pager or query.is_follow)
    return _exit_status(_print(query, lines, is_paged))


def _require_end(until: str, is_follow: bool) -> None:
    if until and is_follow:
        message = "cannot use --follow with --until: journalctl --follow never ends"
        raise usage_error(message, "leave one of them out, or use --until-end")


def _print_machines(scope: Scope) -> int | None:
    """Print the lines of several machines; None if the dataflow runs on one."""
    # Imported late: most dataflows run on one machine.
    from dora_systemd.cli.remote.machines import print_machines

    return print_machines(scope, click.get_current_context())


def last_count(values: Sequence[str]) -> str:
    """The number of lines, "" for none. Raises DoraSystemdError (USAGE)."""
    for value in values:
        if value != ALL_LINES and not re.fullmatch(_COUNT, value):
            message = f"cannot use {quoted(value)} as a number of lines"
            raise usage_error(message, "a number such as 100, or all")
    return values[-1] if values else ""


def _lines(journal: JournalReader, query: LogQuery) -> Lines:
    if not sys.stdout.isatty():
        return None
    if not query.output.startswith("short"):
        return ShownLines()
    is_one = bool(query.name) and not query.others
    known = query.nodes or journal.known_nodes(query.scope, query.name) if is_one else ()
    return TerminalLines(
        [*known, query.name],
        want_dataflow=not is_one,
        want_colors=wants_colors(sys.stdout),
        has_events=not (query.nodes or query.grep or query.level),
    )


def _print(query: LogQuery, lines: Lines, is_paged: bool = False) -> int:
    """Print the records of a query, formatted for a terminal, or by journalctl itself.

    Returns the exit status of journalctl; for a terminal, where a person may end it, 0 or 1.
    """
    if lines is None:
        note = None if query.is_quiet else partial(print_warnings, [_LEFT_OUT])
        return pass_logs(query, sys.stdout.fileno(), note)
    status = list[int]()
    chunks = read_logs(query, lines, wants_colors(sys.stdout), status.append)
    if is_paged:
        print_paged(chunks)
    else:
        _write(chunks, sys.stdout.fileno())
    return ExitCode.FAILURE if status == [ExitCode.FAILURE] else ExitCode.OK


def _exit_status(status: int) -> int:
    """The exit status of journalctl: 1 if --grep found nothing; 128 + signal if it was killed."""
    return status if status >= 0 else 128 - status


def _write(chunks: Iterator[bytes], fd: int) -> None:
    for chunk in chunks:
        write_whole(chunk, fd)


def pager_of(environ: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """The pager and its environment.

    Users who may run doractl as root may not be allowed to run everything as root. So under sudo it
    is less, without its commands that start programs. $SYSTEMD_PAGERSECURE overrides this, as in
    systemctl(1).
    """
    is_lent = any(environ.get(name) for name in ("SUDO_UID", "PKEXEC_UID", "DOAS_USER"))
    word = environ.get("SYSTEMD_PAGERSECURE", "").lower()
    is_secure = word not in ("0", "no", "n", "false", "f", "off") if word else is_lent
    environment = {"LESS": "FRSXMK", **environ, **({"LESSSECURE": "1"} if is_secure else {})}
    if is_secure and not word:
        return "less", environment
    names = (environ.get(name, "").strip() for name in ("DORACTL_PAGER", "SYSTEMD_PAGER", "PAGER"))
    return next(filter(None, names), "less"), environment


@contextmanager
def interrupts_for_pager() -> Iterator[None]:
    """In the context, Ctrl+C does not end doractl: the pager decides what happens.

    less(1) without its option K stays, and must not lose the terminal to the caller's shell.
    """
    # Not SIG_IGN, which the pager would inherit.
    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def print_paged(chunks: Iterator[bytes]) -> None:
    """Print to the pager that journalctl(1) would use, with the same options."""
    from shutil import which

    pager, environment = pager_of(os.environ)
    if not which(pager.split()[0]) or pager == "cat" or is_dumb():
        _write(chunks, sys.stdout.fileno())
        return
    check_program(pager.split()[0])
    with (
        interrupts_for_pager(),
        subprocess.Popen(pager, shell=True, stdin=subprocess.PIPE, env=environment) as child,
    ):
        assert child.stdin
        try:
            _write(chunks, child.stdin.fileno())
        except BrokenPipeError:
            pass  # the user quit the pager
        finally:
            child.stdin.close()

"""Print what the nodes of a dataflow wrote."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import click

from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.cli.colors import is_dumb, wants_colors
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.decisions.logs.query import OUTPUTS, LogQuery, parse_level
from dora_systemd.decisions.logs.terminal import ShownLines, TerminalLines
from dora_systemd.errors import ExitCode
from dora_systemd.verbs.logs import find_query, pass_logs, read_logs

Lines = TerminalLines | ShownLines | None
"""Formats lines for a terminal; None for a pipe."""


@click.command("logs")
@click.argument("selector", default="")
@click.option(
    "-n",
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
    help="Wait for new lines; starts with the last 10 unless --tail or --since is given.",
)
@click.option(
    "--until-end",
    is_flag=True,
    help="Follow until the dataflow has ended; keeps following across restarts.",
)
@click.option("--tail", type=click.IntRange(min=0), metavar="N", help="Only the last N lines.")
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
    help="This level and above: error, warn, info, debug, trace.",
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
    help="CURRENT, PREVIOUS, ALL or the id of a run (DORA_RUN).",
)
@click.option(
    "--events", "is_events", is_flag=True, help="Only what happened to the dataflow and its nodes."
)
@click.option("-r", "--reverse", "is_reverse", is_flag=True, help="Newest lines first.")
@click.option(
    "-a",
    "--all",
    "want_unprintable",
    is_flag=True,
    help="Include messages with control characters: escaped on a terminal, unchanged in a pipe.",
)
@click.option(
    "-o",
    "--output",
    type=click.Choice(OUTPUTS),
    default="short",
    show_default=True,
    help="Output format, as in journalctl.",
)
@click.option("--no-pager", is_flag=True, help="Do not use a pager.")
@scope_options
def command(
    selector: str,
    nodes: tuple[str, ...],
    run: str,
    no_pager: bool,
    until_end: bool,
    **options: Any,
) -> int:
    """Print what the nodes of a dataflow wrote, and what happened to them.

    Without SELECTOR: the logs of all dataflows. The dataflow may have ended long ago.

    Examples:
      doractl logs robot                          all there is, in a pager
      doractl logs robot --node camera --follow   what one node writes, from now on
      doractl logs robot --until-end -o json      all until it ends, for a program
      doractl logs robot --tail 100 --level warn  the last 100 warnings and errors
      doractl logs robot --run PREVIOUS --events  what happened to the run before this one
      journalctl -t robot/camera                  the same records, with systemd's own tool
    """
    options.pop("all_nodes")
    options["level"] = parse_level(options["level"]) if options["level"] else ""
    scope = current_scope()
    check_readable(scope)
    if until_end:
        # Imported late: only --until-end needs it.
        from dora_systemd.verbs.follow import check_until_end, follow_to_end

        check_until_end(selector, options["is_reverse"])
    journal = JournalReader()
    query = find_query(journal, LogQuery(scope, **options), selector, nodes, run)
    lines: Lines = ShownLines() if sys.stdout.isatty() else None
    if sys.stdout.isatty() and query.output.startswith("short"):
        known = query.nodes or (journal.known_nodes(query.name) if query.name else ())
        lines = TerminalLines(
            [*known, query.name],
            want_dataflow=not query.name,
            want_colors=wants_colors(sys.stdout),
            has_events=not (query.nodes or query.grep or query.level),
        )
    if until_end:
        follow_to_end(query, lambda step: _print(step, lines))
        return ExitCode.OK
    if no_pager or query.is_follow or lines is None:
        return _exit_status(_print(query, lines))
    _page(read_logs(query, lines, wants_colors(sys.stdout)))
    return ExitCode.OK


def _print(query: LogQuery, lines: Lines) -> int:
    """Print the records of a query, formatted for a terminal, or by journalctl itself."""
    if lines is None:
        return pass_logs(query, sys.stdout.fileno())
    _write(read_logs(query, lines, wants_colors(sys.stdout)), sys.stdout.fileno())
    return ExitCode.OK


def _exit_status(status: int) -> int:
    """The exit status of journalctl: 1 if --grep found nothing; 128 + signal if it was killed."""
    return status if status >= 0 else 128 - status


def _write(chunks: Iterator[bytes], fd: int) -> None:
    for chunk in chunks:
        rest = memoryview(chunk)
        while rest:
            rest = rest[os.write(fd, rest) :]


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
    names = (environ.get(name, "") for name in ("DORACTL_PAGER", "SYSTEMD_PAGER", "PAGER"))
    return next(filter(None, names), "less"), environment


def _page(chunks: Iterator[bytes]) -> None:
    """Print to the pager that journalctl(1) would use, with the same options."""
    pager, environment = pager_of(os.environ)
    if not shutil.which(pager.split()[0]) or pager == "cat" or is_dumb():
        _write(chunks, sys.stdout.fileno())
        return
    with subprocess.Popen(pager, shell=True, stdin=subprocess.PIPE, env=environment) as child:
        assert child.stdin
        try:
            _write(chunks, child.stdin.fileno())
        except BrokenPipeError:
            pass  # the user quit the pager
        finally:
            child.stdin.close()

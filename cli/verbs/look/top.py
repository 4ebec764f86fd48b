"""Show live resource usage of dataflows and nodes."""

import re
import sys
import time
from functools import partial

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.listing import print_table
from dora_systemd.cli.parameters import current_scope, output_option, parsed_by, scope_options
from dora_systemd.cli.screen import FIRST_SECONDS, show_live
from dora_systemd.cli.terminal import is_dumb
from dora_systemd.decisions.views.objects import format_json
from dora_systemd.decisions.views.top import SORTS, format_top, look_values
from dora_systemd.errors import ExitCode, usage_error
from dora_systemd.values import quoted
from dora_systemd.verbs.top import Top

_SECONDS = r"[0-9]{1,5}(\.[0-9]*)?|\.[0-9]+"


def parse_interval(text: str) -> float:
    """Seconds between two readings. Raises DoraSystemdError (USAGE), also for "nan" and "inf"."""
    seconds = float(text) if re.fullmatch(_SECONDS, text) else 0.0
    if seconds < 0.1:
        raise usage_error(f"cannot use {quoted(text)} as an interval", "0.1 to 99999 seconds")
    return seconds


@click.command("top")
@click.argument("selectors", nargs=-1, metavar="[SELECTOR]...")
@click.option(
    "--interval",
    default="2",
    callback=parsed_by(parse_interval),
    show_default=True,
    metavar="SECONDS",
    help="Time from one reading to the next.",
)
@click.option(
    "--sort",
    type=click.Choice(SORTS),
    default="cpu",
    show_default=True,
    help="Sort by CPU, memory (highest first) or name.",
)
@click.option("--once", "is_once", is_flag=True, help="Print one reading and exit.")
@output_option
@scope_options
def command(
    selectors: tuple[str, ...], interval: float, sort: str, is_once: bool, output: str
) -> int:
    """Show live resource usage of dataflows and their nodes; without SELECTOR, of all that run.

    On a terminal: the arrow keys select a row, R restarts it and S stops it, ? shows all keys, and
    q quits. In a pipe one reading is printed; with JSON, one object per line until it is
    interrupted.

    Examples:
      doractl top                          all that run, until q
      doractl top robot --sort memory      one dataflow, the largest nodes first
      doractl top --once                   one reading, for a script or a report
      doractl top -o json --interval 10    a JSON object every ten seconds
    """
    scope = current_scope()
    top = Top(Bus(scope, for_reading=True), scope, selectors)
    top.look()
    is_terminal = sys.stdin.isatty() and sys.stdout.isatty() and not is_dumb()
    try:
        if output == "json":
            _print_objects(top, interval, sort, is_once)
        elif is_once or not is_terminal:
            time.sleep(FIRST_SECONDS)
            print_table(partial(format_top, top.look(), sort))
        else:
            show_live(scope, top, interval, sort)
    except KeyboardInterrupt:
        # Ctrl+C quits, as in top(1).
        pass
    return ExitCode.OK


def _print_objects(top: Top, interval: float, sort: str, is_once: bool) -> None:
    time.sleep(FIRST_SECONDS)
    while True:
        print(format_json(look_values(top.look(), sort)), flush=True)
        if is_once:
            return
        time.sleep(interval)

"""`doractl top` on a terminal: readings and keys for the screen, changes in the background."""

import sys
import time
from threading import Thread

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.colors import wants_colors
from dora_systemd.cli.screen import Screen, open_screen
from dora_systemd.decisions.views.top_screen import Change, TopScreen
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.act import act_on
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.top import Top

FIRST_SECONDS = 0.5
"""Time between the two samples of one reading."""


class Work(Thread):
    """One change that is being made; a dataflow takes its grace duration to stop.

    A daemon, so that Ctrl+C ends doractl; systemd goes on, as after Ctrl+C in `doractl stop`.
    """

    def __init__(self, scope: Scope, change: Change, view: TopScreen, screen: Screen) -> None:
        super().__init__(daemon=True)
        self._scope, self.change = scope, change
        self._view, self._screen = view, screen
        self.result = ""

    def run(self) -> None:
        action, row = self.change
        try:
            self._say(f"{self.change} ...")
            by = "doractl top"
            bus = Bus(self._scope)
            cell = Selector(row.uuid).find(bus)
            self.result = act_on(
                bus, self._scope, cell, row.node, action, by=by, on_stage=self._say_stage
            )
        except Exception as error:  # whatever it is, it must not be printed over the screen
            is_ours = isinstance(error, DoraSystemdError)
            self.result = f"doractl: {error if is_ours else repr(error)}"
        self._say(self.result)

    def _say_stage(self, stage: str) -> None:
        self._say(f"{self.change}: {stage}")

    def _say(self, text: str) -> None:
        self._view.said = text
        self._screen.wake()


def show_live(scope: Scope, top: Top, interval: float, sort: str) -> None:
    """Show one reading after the other, until the person quits.

    interval: seconds between two. Changes that are not finished then are waited for. Raises
    DoraSystemdError.
    """
    view, works = TopScreen(sort), list[Work]()
    with open_screen(wants_colors(sys.stdout)) as screen:
        view.see(top.look())
        due = time.monotonic() + FIRST_SECONDS
        while not view.is_over:
            screen.show(view.lines(*screen.size()))
            if change := view.press(screen.wait_key(due - time.monotonic())):
                works.append(Work(scope, change, view, screen))
                works[-1].start()
            if time.monotonic() >= due:
                view.see(top.look())
                due = time.monotonic() + interval
        works = [work for work in works if work.is_alive()]
    for work in works:
        click.echo(f"{work.change} ...", err=True)
        work.join()
        click.echo(work.result)

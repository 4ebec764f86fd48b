"""What `doractl top` does in the background, and what it says about it."""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import pytest

from dora_systemd.cli.live import Work
from dora_systemd.cli.screen import Screen
from dora_systemd.decisions.views.top import TopRow
from dora_systemd.decisions.views.top_screen import Change, TopScreen
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

ROBOT = TopRow(UUID, "robot", "", "Running", ())


@dataclass
class Woken:
    """The screen as a thread knows it. said: what the view says each time."""

    view: TopScreen
    said: tuple[str, ...] = ()

    def wake(self) -> None:
        self.said += (self.view.said,)


def said_about(change: Change, manager: FakeManager, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    fake_systemd(monkeypatch, manager)
    screen = Woken(TopScreen("cpu"))
    scope = ScopeIn(is_user=True, uid=1000, root=Path("/nowhere"))
    work = Work(scope, change, screen.view, cast(Screen, screen))
    work.start()
    work.join()
    assert work.result == screen.said[-1]
    return list(screen.said)


def test_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    manager = FakeManager()
    manager.add(options())
    said = said_about(Change("restart", ROBOT), manager, monkeypatch)
    assert said[0] == "Restart robot ..."
    assert said[-1] == f"Dataflow restarted: {UUID} (robot)"


def test_an_error_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    said = said_about(Change("stop", ROBOT), FakeManager(), monkeypatch)
    assert said[-1].startswith("doractl: no dataflow ")

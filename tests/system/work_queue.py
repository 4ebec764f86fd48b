"""One queue of test modules for several containers: each runs the modules that it takes first."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import pytest

from tests.system.usage import Usage


class InModule(Protocol):
    """What is looked at of a pytest.Item."""

    @property
    def path(self) -> Path: ...


Item = TypeVar("Item", bound=InModule)
LONGEST = (
    *("test_fidelity_exit", "test_restarts", "test_history", "test_transcripts"),
    *("test_faults", "test_gateway", "test_remote", "test_enable", "test_hotreload"),
    *("test_stop_order", "test_record", "test_logs_flow", "test_versions"),
    *("test_flow_cables", "test_flow_stop", "test_flow_faults", "test_flow"),
)
"""Modules that take longest, which a queue begins with."""
USAGE = pytest.StashKey[Usage]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--queue", type=Path, help="run only modules that no other container takes")


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    queue = session.config.getoption("--queue")
    if not queue or session.config.option.collectonly:
        return None
    session.config.stash[USAGE] = Usage()
    run_queue(session, queue)
    return True


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Say what the modules of a queue take, for the next one who looks for minutes."""
    if USAGE in config.stash:
        terminalreporter.section("the longest modules")
        for line in config.stash[USAGE].lines():
            terminalreporter.write_line(line)


def in_order(config: pytest.Config, items: list[pytest.Item]) -> list[pytest.Item]:
    """The tests in the order in which a queue is worked on, if there is one."""
    return longest_first(items, LONGEST) if config.getoption("--queue") else items


def take_items(items: Iterable[Item], queue: Path) -> Iterator[Item]:
    """Yield the tests of the modules that nobody else has taken, a module at a time.

    mkdir(2) of the name of a module takes it: one of the containers succeeds.
    """
    modules: dict[Path, list[Item]] = {}
    for item in items:
        modules.setdefault(item.path, []).append(item)
    for path, tests in modules.items():
        if _take(queue / f"{path.parent.name}-{path.stem}"):
            yield from tests


def _take(place: Path) -> bool:
    try:
        place.mkdir()
    except FileExistsError:
        return False
    return True


def longest_first(items: Iterable[Item], longest: Sequence[str]) -> list[Item]:
    """Sort by module: a long one that is taken last would run alone at the end."""
    order = {name: place for place, name in enumerate(longest)}
    return sorted(items, key=lambda item: order.get(item.path.stem, len(order)))


def run_queue(session: pytest.Session, queue: Path) -> None:
    """Run what this container takes; raise what ends a session early, as pytest's own loop."""
    taken = take_items(session.items, queue)
    item = next(taken, None)
    while item:
        # Taken before `item` runs: pytest keeps the fixtures that the next test needs too.
        following = next(taken, None)
        with session.config.stash[USAGE].of(item.path.stem):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if session.shouldfail:
            raise session.Failed(session.shouldfail)
        if session.shouldstop:
            raise session.Interrupted(session.shouldstop)
        item = following

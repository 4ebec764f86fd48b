"""What all unit tests have in common."""

import signal
from pathlib import Path

import pytest
from hypothesis import settings

from tests.unit.checkout import CHECKOUT

# They take longest by far, so a run on several processors begins with them.
LONG = ("tests/unit/project/test_linters.py", "tests/unit/project/test_late_imports.py")

# A shell hands SIGINT on ignored to what it starts in the background, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no bug: how long an example takes is not what these tests are about.
# Each run draws others; `make fuzz` draws as many as one has time for.
settings.register_profile("house", deadline=None, max_examples=40)
settings.load_profile("house")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--first", default="", help="folders whose tests come first, with , between")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    first = [name for name in config.getoption("--first").split(",") if name]
    if first:
        items.sort(key=lambda item: _rank(item.path.relative_to(CHECKOUT), first))


def _rank(path: Path, first: list[str]) -> int:
    if str(path) in LONG:
        return 0
    return 1 if any(path.is_relative_to(folder) for folder in first) else 2

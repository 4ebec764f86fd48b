"""Programs that some unit tests ask for a second opinion, and that not every machine has."""

import importlib
import importlib.util
import shutil
from typing import Any

import pytest

from tests.unit.checkout import CHECKOUT

# Where the lab has its copy of the checkout; `make test` runs the unit tests there too.
IN_LAB = str(CHECKOUT) == "/src"


def require(tool: str) -> None:
    """Skips where the tool is missing; in the lab it must be there."""
    if not shutil.which(tool):
        assert not IN_LAB, f"the lab has no {tool}"
        pytest.skip(f"no {tool} here; the lab has it")


def require_module(name: str) -> Any:
    """Import a module of PyPI; skips where it is missing, and in the lab it must be there."""
    if not importlib.util.find_spec(name.partition(".")[0]):
        assert not IN_LAB, f"the lab has no {name}"
        pytest.skip(f"no {name} here; the lab has it")
    return importlib.import_module(name)

"""A plugin of pytest that lets each run import the tests again.

mutmut runs them once, and forks a process for each mutant. There Python would have the modules
already, and the tables in them whose values the original had made.
"""

import os
import sys
import warnings
from types import ModuleType

import pytest

# What their tests have left open would otherwise be reported as if a mutant had.
_former: list[ModuleType] = []


def pytest_configure() -> None:
    """Forget the modules of tests. Fixtures and fakes stay: conftest.py has been imported."""
    for name in list(sys.modules):
        if name.startswith("tests.unit.") and name.rpartition(".")[2].startswith("test_"):
            _former.append(sys.modules.pop(name))


@pytest.hookimpl(tryfirst=True)
def pytest_unconfigure() -> None:
    """Report nothing that is left open by the mutant with which mutmut sees that tests can fail."""
    if os.environ.get("MUTANT_UNDER_TEST") == "fail":
        warnings.simplefilter("ignore")

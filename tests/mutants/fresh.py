"""A plugin of pytest that lets each run import the tests again.

mutmut runs them once, and forks a process for each mutant. There Python would have the modules
already, and the tables in them whose values the original had made.
"""

import sys


def pytest_configure() -> None:
    """Forget the modules of tests. Fixtures and fakes stay: conftest.py has been imported."""
    for name in list(sys.modules):
        if name.startswith("tests.unit.") and name.rpartition(".")[2].startswith("test_"):
            del sys.modules[name]

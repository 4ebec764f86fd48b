"""After a test without flow_on(): no unexpected warning in the journal of any machine."""

from collections.abc import Iterator

import pytest

from tests.machines import journals
from tests.machines.flows import GRACE, THREE, TWO, Flow, flow_on
from tests.system.work_queue import (
    in_order,
    pytest_addoption,
    pytest_runtestloop,
    pytest_terminal_summary,
)

__all__ = ["pytest_addoption", "pytest_runtestloop", "pytest_terminal_summary"]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    items[:] = in_order(config, items)


def pytest_make_parametrize_id(val: object) -> str | None:
    """Name the members of a dataflow in the names of tests."""
    return "two" if val == TWO else "three" if val == THREE else None


@pytest.fixture(params=[THREE])
def flow(request: pytest.FixtureRequest) -> Iterator[Flow]:
    """A dataflow that runs, and is started again whatever ends it.

    A fault is tried on two machines or on three, and its kind on both: what a head does when it
    loses something is the same for each of its members.
    """
    policy = ("--restart-policy=on-failure", "--max-restarts=50", f"--grace-duration={GRACE}s")
    with flow_on(Flow(request.param), journals.announced(request)) as flow:
        flow.start(*policy)
        flow.wait_exchanging()
        yield flow


@pytest.fixture
def quiet_journals(request: pytest.FixtureRequest) -> Iterator[None]:
    """Comes before the dataflow, and looks when that has ended."""
    with journals.quiet_journals(journals.announced(request)):
        yield

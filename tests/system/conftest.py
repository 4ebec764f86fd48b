"""After every system test: no process is left over, and no unexpected warning in the journal."""

import os
import shutil
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, wait_no_process
from tests.system.chromium import Browser
from tests.system.complaints import complaints, end_of_journal
from tests.system.gateways import Front
from tests.system.ports import reserve_ports
from tests.system.releases import Releases
from tests.system.work_queue import in_order, pytest_addoption, pytest_runtestloop

__all__ = ["pytest_addoption", "pytest_runtestloop"]

LONGEST_SECONDS = 300
"""No test takes a tenth of it: one that hangs fails, shows where it stood, and the others run."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.system)
            item.add_marker(pytest.mark.timeout(bound(LONGEST_SECONDS)))
    items[:] = in_order(config, items)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """With a failure, what a person would look at next."""
    report = yield
    cell = getattr(item, "funcargs", {}).get("cell")
    if call.when == "call" and report.failed and isinstance(cell, Cell):
        try:
            words = cell.last_words()
        except Exception as error:  # an exception here would end the whole session
            words = repr(error)
        report.sections.append(("the dataflow", words))
    return report


@pytest.fixture
def project() -> Iterator[Project]:
    root = Path(tempfile.mkdtemp(prefix="flow-", dir="/var/tmp"))
    root.chmod(0o755)
    yield Project(root / "project")
    shutil.rmtree(root)


@pytest.fixture
def cell(request: pytest.FixtureRequest, project: Project) -> Iterator[Cell]:
    del project  # it outlives the cell, as files of a dataflow do
    name = request.node.name.removeprefix("test_").replace("[", "-").replace("]", "")
    cell = Cell("".join(c if c.isalnum() else "-" for c in name).strip("-")[:60])
    cursor = end_of_journal()
    yield cell
    cell.end()
    wait_no_process()
    expected = [m for mark in request.node.iter_markers("warns") for m in mark.args]
    unexpected = complaints(cursor, expected)
    assert not unexpected, "unexpected warnings:\n" + "\n".join(unexpected)


@pytest.fixture
def releases(cell: Cell) -> Iterator[Releases]:
    """Those of the cell; they go to /etc and /var/lib."""
    releases = Releases(cell)
    yield releases
    releases.end()


@pytest.fixture(scope="module")
def units_for_all() -> Iterator[None]:
    """The units of `doractl setup`, which notices and bundles after failures need."""
    run("doractl", "setup")
    yield
    run("doractl", "setup", "--remove", check=False)


@pytest.fixture(scope="session", autouse=True)
def reserved_ports() -> None:
    """Before the first connection: one that has ended holds its port for another minute."""
    if os.geteuid() == 0:
        reserve_ports()


@pytest.fixture
def front() -> Iterator[Front]:
    """The gateway of the system, down."""
    front = Front()
    yield front
    front.end()


@pytest.fixture
def alice() -> Iterator[Front]:
    """The gateway of alice, down."""
    front = Front("alice", 1000, 53291)
    yield front
    front.end()


@pytest.fixture
def gateway_up(front: Front) -> None:
    """For modules whose tests all ask the system's gateway."""
    front.up()


@pytest.fixture
def browser(front: Front, gateway_up: None, cell: Cell) -> Iterator[Browser]:
    """At the page of the system's gateway, in which nothing comes from elsewhere by the end."""
    del gateway_up, cell  # the dataflow ends after the browser has looked at it
    place = f"127.0.0.1:{front.port}/"
    with Browser() as browser:
        browser.open(f"http://{place}")
        yield browser
        # Chromium draws the field of a time with pictures of its own.
        own = (f"http://{place}", f"ws://{place}", "blob:", "data:image/svg+xml;base64,")
        assert [url for url in browser.requests() if not url.startswith(own)] == []

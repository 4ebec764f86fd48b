"""After every system test: no process is left over, and no unexpected warning in the journal."""

import os
import shutil
import tempfile
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.lab.marked import marked_files
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, wait_no_process
from tests.system.chromium import Browser
from tests.system.complaints import complaints, end_of_journal
from tests.system.gateways import Front
from tests.system.ports import reserve_ports
from tests.system.releases import Releases
from tests.system.work_queue import (
    in_order,
    pytest_addoption,
    pytest_runtestloop,
    pytest_terminal_summary,
)

__all__ = ["pytest_addoption", "pytest_runtestloop", "pytest_terminal_summary"]

LONGEST_SECONDS = 300
"""No test takes a tenth of it: one that hangs fails, shows where it stood, and the others run."""
OWN_LABS = ("vm", "emulator", "openarm", "browser")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.system)
            item.add_marker(pytest.mark.timeout(bound(LONGEST_SECONDS)))
    for mark in OWN_LABS:
        check_files(mark, items)
    items[:] = in_order(config, items)


def check_files(mark: str, items: Iterable[pytest.Item]) -> None:
    """A lab of its own reads only the files that name its mark, and would miss another test."""
    known = {*marked_files(mark)}
    missed = [one.nodeid for one in items if one.get_closest_marker(mark) and one.path not in known]
    if missed:
        raise pytest.UsageError(f"tests/lab/marked.py does not find the mark {mark} of {missed}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """With a failure, what a person would look at next."""
    report = yield
    given = getattr(item, "funcargs", {})
    cell = given.get("cell") or given.get("running")
    if call.when == "call" and report.failed and isinstance(cell, Cell):
        try:
            words = cell.last_words()
        except Exception as error:  # an exception here would end the whole session
            words = repr(error)
        report.sections.append(("the dataflow", words))
    return report


@contextmanager
def new_project() -> Iterator[Project]:
    """A project below /var/tmp, which is removed at the end."""
    root = Path(tempfile.mkdtemp(prefix="flow-", dir="/var/tmp"))
    root.chmod(0o755)
    try:
        yield Project(root / "project")
    finally:
        shutil.rmtree(root)


@contextmanager
def new_cell(name: str, expected: Iterable[str]) -> Iterator[Cell]:
    """A cell that leaves no process, and no warning in the journal but those expected."""
    cell = Cell("".join(c if c.isalnum() else "-" for c in name).strip("-")[:60])
    cursor = end_of_journal()
    try:
        yield cell
    finally:
        cell.end()
    wait_no_process()
    unexpected = complaints(cursor, expected)
    assert not unexpected, "unexpected warnings:\n" + "\n".join(unexpected)


def announced(request: pytest.FixtureRequest) -> list[str]:
    """The warnings that a test or a class expects, by its marks `warns`."""
    return [one for mark in request.node.iter_markers("warns") for one in mark.args]


@pytest.fixture
def project() -> Iterator[Project]:
    with new_project() as project:
        yield project


@pytest.fixture
def cell(request: pytest.FixtureRequest, project: Project) -> Iterator[Cell]:
    del project  # it outlives the cell, as files of a dataflow do
    name = request.node.name.removeprefix("test_").replace("[", "-").replace("]", "")
    with new_cell(name, announced(request)) as cell:
        yield cell


@pytest.fixture(scope="class")
def class_project() -> Iterator[Project]:
    """For a class of tests that share it."""
    with new_project() as project:
        yield project


@pytest.fixture(scope="class")
def class_cell(request: pytest.FixtureRequest, class_project: Project) -> Iterator[Cell]:
    """The cell of a class of tests, called as both: its tests only look at one dataflow."""
    del class_project  # as above
    module = request.module.__name__.rpartition(".test_")[2]
    name = f"{module}-{request.node.name.removeprefix('Test')}".lower()
    with new_cell(name, announced(request)) as cell:
        yield cell


@pytest.fixture(scope="class")
def running(class_cell: Cell, class_project: Project) -> Cell:
    """Three nodes, started once for a class of tests that only look at them."""
    class_cell.start(class_project.three_nodes())
    return class_cell


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


@contextmanager
def page_of(front: Front) -> Iterator[Browser]:
    """A browser at the page of a gateway, in which nothing comes from elsewhere by the end."""
    place = f"127.0.0.1:{front.port}/"
    with Browser() as browser:
        browser.open(f"http://{place}")
        yield browser
        # Chromium draws the field of a time with pictures of its own.
        own = (f"http://{place}", f"ws://{place}", "blob:", "data:image/svg+xml;base64,")
        assert [url for url in browser.requests() if not url.startswith(own)] == []


@pytest.fixture
def browser(front: Front, gateway_up: None, cell: Cell) -> Iterator[Browser]:
    """At the page of the system's gateway."""
    del gateway_up, cell  # the dataflow ends after the browser has looked at it
    with page_of(front) as browser:
        yield browser


@pytest.fixture(scope="module")
def page() -> Iterator[Browser]:
    """One page for all tests of a module that run the page's scripts and need no dataflow."""
    front = Front()
    front.up()
    with page_of(front) as browser:
        yield browser
    front.end()

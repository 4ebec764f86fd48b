"""A bad version of each kind: the old one runs again, or runs on, and the journal says why."""

from collections.abc import Iterator

import pytest

from tests.system.cells import Cell, Project
from tests.system.deploy.versions import BAD, Version
from tests.system.releases import Releases, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab


@pytest.fixture(scope="class")
def proved(class_cell: Cell, class_project: Project) -> Iterator[Releases]:
    """A dataflow whose current release is a good one."""
    releases = Releases(class_cell)
    write_version(class_project, "good")
    try:
        releases.deploy(class_project.root, "--soak", "0s")
        yield releases
    finally:
        releases.end()


@pytest.fixture
def written(class_project: Project, bad: Version) -> Iterator[Project]:
    """The bad version in the place of the good one."""
    for name, text in bad.files.items():
        class_project.write(name, text)
    yield class_project
    for name in bad.files:
        (class_project.root / name).unlink()
    write_version(class_project, "good")


@pytest.mark.warns(
    "crashed", "failed", "Failed", "exit", "error", "is silent", "restarted", "was ended"
)
@pytest.mark.warns("is ended by its watchdog", "after failure", "ready")
class TestBadVersions:
    """One after the other, as in a bad week."""

    @pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
    def test_it_is_undone(self, proved: Releases, written: Project, bad: Version) -> None:
        good, life = proved.current(), proved.cell.show("InvocationID")
        before = proved.states()
        assert bad.says in proved.deploy(written.root, *bad.flags, status=bad.status)
        proved.check_only(good)
        if not bad.why:
            assert proved.cell.show("InvocationID") == life, "it was never stopped"
            assert proved.states() == before
            return
        (newest, state), *_ = proved.states().items()
        assert (newest in before, state) == (False, "failed")
        why = proved.cell.doractl("why", proved.cell.name).stdout
        assert bad.why in why.partition("Undone:")[2].splitlines()[0]
        assert "by whom is not recorded" not in why

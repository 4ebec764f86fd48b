"""A bad version of each kind: the old one runs again, or runs on, and the journal says why."""

import pytest

from tests.system.cells import Project
from tests.system.deploy.versions import BAD, Version
from tests.system.releases import Releases, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab


@pytest.mark.warns(
    "crashed", "failed", "Failed", "exit", "error", "is silent", "restarted", "was ended"
)
@pytest.mark.warns("is ended by its watchdog", "after failure", "ready")
@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
def test_a_bad_version_is_undone(releases: Releases, project: Project, bad: Version) -> None:
    write_version(project, "good")
    releases.deploy(project.root, "--soak", "0s")
    good, life = releases.current(), releases.cell.show("InvocationID")
    for name, text in bad.files.items():
        project.write(name, text)
    assert bad.says in releases.deploy(project.root, *bad.flags, status=bad.status)
    releases.check_only(good)
    if not bad.why:
        assert releases.cell.show("InvocationID") == life, "it was never stopped"
        assert list(releases.states().values()) == ["current"]
        return
    assert list(releases.states().values()) == ["failed", "current"]
    why = releases.cell.doractl("why", releases.cell.name).stdout
    assert bad.why in why.partition("Undone:")[2].splitlines()[0]
    assert "by whom is not recorded" not in why

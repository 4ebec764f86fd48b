"""The example of a hook post-receive: a push deploys, and only the user who pushes runs git."""

import json
import pwd
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import run, wait_for
from tests.system.releases import FLOW, NODE
from tests.unit.checkout import CHECKOUT

# It needs a user with a manager, and an empty home.
pytestmark = pytest.mark.lab

HOOK = CHECKOUT / "examples/deploy/post-receive"
USER = "alice"
UNIT = "dora-robot.service"
SPY = "#!/bin/sh\nid -u >>{place}\ncat\n"


class Pusher:
    """Alice, with a project of hers and a bare repository that deploys it."""

    def __init__(self) -> None:
        entry = pwd.getpwnam(USER)
        self.home, self.uid = Path(entry.pw_dir), entry.pw_uid
        wait_for("her manager", lambda: Path(f"/run/user/{self.uid}/bus").exists())
        self.project, self.bare = self.home / "work", self.home / "robot.git"
        self.run("git", "init", "-q", "--bare", str(self.bare))
        self.run("git", "init", "-q", "--initial-branch=main", str(self.project))
        hook = self.bare / "hooks/post-receive"
        # Who has an hour reads the example as it is.
        hook.write_text(HOOK.read_text().replace("2min", "1s"))
        hook.chmod(0o755)

    def run(self, *words: str, check: bool = True) -> "subprocess.CompletedProcess[str]":
        """Run a command as alice has it after a login."""
        runtime = f"XDG_RUNTIME_DIR=/run/user/{self.uid}"
        own = ("env", runtime, f"HOME={self.home}", "GIT_CONFIG_NOSYSTEM=1", *words)
        return run("runuser", "-u", USER, "--", *own, check=check, cwd=self.home)

    def commit(self, version: str, before: str = "") -> str:
        """Commit a version of the project; its revision."""
        for name, text in (("dataflow.yml", FLOW), ("a.py", before + NODE.format(version=version))):
            path = self.project / name
            path.write_text(text)
            shutil.chown(path, USER, USER)
        own = ("-c", "user.name=a", "-c", "user.email=a@localhost", "-C", str(self.project))
        self.run("git", *own, "add", "--all")
        self.run("git", *own, "commit", "-q", "-m", version)
        return self.run("git", *own, "rev-parse", "HEAD").stdout.strip()

    def push(self, where: str = "main") -> list[str]:
        """Push; what the hook says."""
        words = ("git", "-C", str(self.project), "push", str(self.bare), f"HEAD:refs/heads/{where}")
        said = self.run(*words).stderr.splitlines()
        return [one.removeprefix("remote: ").strip() for one in said if one.startswith("remote: ")]

    def current(self) -> str:
        """The release that runs."""
        rows = json.loads(self.run("doractl", "--user", "releases", "robot", "-o", "json").stdout)
        (found,) = [str(row["release"]) for row in rows if row["state"] == "current"]
        return found

    def end(self) -> None:
        """Leave nothing of it."""
        self.run("doractl", "--user", "disable", "robot", check=False)
        self.run("doractl", "--user", "stop", "robot", check=False)
        self.run("systemctl", "--user", "reset-failed", UNIT, check=False)
        state = self.home / ".local/state/dora-systemd"
        for path in (self.project, self.bare, self.home / "robot", state):
            run("chmod", "-R", "u+w", str(path), check=False)
            shutil.rmtree(path, ignore_errors=True)
        (self.home / "robot.lock").unlink(missing_ok=True)


@pytest.fixture
def pusher() -> Iterator[Pusher]:
    found = Pusher()
    yield found
    found.end()


def test_a_push_deploys(pusher: Pusher) -> None:
    spy, place = pusher.project / "spy", pusher.home / "proof"
    spy.write_text(SPY.replace("{place}", str(place)))
    spy.chmod(0o755)
    # A program that the repository configures: git runs it at each checkout.
    (pusher.project / ".gitattributes").write_text("a.py filter=spy\n")
    pusher.run("git", "config", "--global", "filter.spy.smudge", str(spy))
    try:
        first = pusher.commit("1")
        said = pusher.push()
        assert [line for line in said if line.startswith("copied: 4 files")], said
        assert "trial: 1/1 nodes ready, soak 1/1 s" in said
        assert "\r" not in "".join(said)
        # The release has the revision, although git leads hooks to the bare repository.
        assert pusher.current().endswith(f"-{first[:7]}")
        assert [line for line in said if line == f"Release: {pusher.current()}"]
        assert {*place.read_text().split()} == {str(pusher.uid)}
    finally:
        pusher.run("git", "config", "--global", "--remove-section", "filter.spy", check=False)
        place.unlink(missing_ok=True)
    # Another branch deploys nothing; a bad version is undone, and whoever pushes is told.
    kept = pusher.current()
    pusher.commit("2", "raise SystemExit(3)\n")
    assert pusher.push("other") == []
    said = pusher.push()
    assert [line for line in said if line.endswith("was rolled back: node a: exit code 3")], said
    assert pusher.current() == kept
    # Root does not push here: git would run what the repository configures.
    refused = run(str(pusher.bare / "hooks/post-receive"), check=False, cwd=pusher.bare)
    assert (refused.returncode, "as another user than root" in refused.stderr) == (1, True)

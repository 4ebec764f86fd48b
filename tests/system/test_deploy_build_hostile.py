"""doractl deploy as root, of a project whose build means harm."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import run, sync_journal
from tests.system.homes import Home
from tests.system.releases import STORE, Releases

pytestmark = pytest.mark.lab

FLOW = """
nodes:
- id: a
  path: a.py
  build: sh build.sh
  inputs: {t: dora/timer/millis/50}
"""
SECRET = Path("/var/lib/doractl-test-secret")
WORDS = "of root alone"
TRIES = """
{
id -u
cat SECRET
ls STORE STORE/others STORE/*/*/tree/a.py
for place in / /etc /usr /var/lib STORE "$PWD/.." "$PWD/../.." /run /home/eve; do
    touch "$place/proof-of-build" && echo "wrote to $place"
done
journalctl --system --quiet --no-pager --lines 50 --output cat
cat /run/credentials/*/* "$CREDENTIALS_DIRECTORY"/*
systemctl stop TARGET
chmod 4755 build.sh
ln SECRET hard
} >said 2>errors
true
"""


@pytest.fixture
def eve() -> Iterator[Home]:
    home = Home("eve")
    home.write("dataflow.yml", FLOW)
    yield home
    shutil.rmtree(home.root)


@pytest.fixture
def secret() -> Iterator[Path]:
    SECRET.write_text(WORDS)
    SECRET.chmod(0o600)
    others = STORE / "others"
    (others / "20260101T000000/tree").mkdir(parents=True)
    (others / "20260101T000000/tree/a.py").write_text(WORDS)
    yield SECRET
    SECRET.unlink()
    shutil.rmtree(others)


@pytest.mark.usefixtures("secret")
def test_a_build_sees_and_changes_nothing_else(releases: Releases, eve: Home) -> None:
    run("logger", WORDS)
    sync_journal()
    build = TRIES.replace("SECRET", str(SECRET)).replace("STORE", str(STORE))
    eve.write("build.sh", build.replace("TARGET", "systemd-journald.service"))
    releases.deploy(eve.root, "--soak", "0s", "--credential", f"key={SECRET}")
    tree = releases.path / releases.current() / "tree"
    said = (tree / "said").read_text()
    assert said.splitlines()[0] == str(eve.uid)
    assert WORDS not in said
    assert "others" not in said
    assert "wrote to" not in said, said
    for place in ("/", "/etc", "/usr", "/var/lib", str(STORE), "/run", "/home/eve"):
        assert not Path(place, "proof-of-build").exists()
    assert not (tree / "hard").exists()
    assert (tree / "build.sh").stat().st_mode & 0o7777 == 0o444
    releases.check_whole()


DEEP = """
import os
for _ in range(3000):
    os.mkdir("d" * 9)
    os.chdir("d" * 9)
"""
LEFT = {
    "a link to a secret": f"ln -s {SECRET} link",
    "a link in place of a directory": "mkdir d; touch d/f; rm -r d; ln -s / d",
    "a link of a venv": "mkdir -p v/bin; touch v/pyvenv.cfg; ln -s /home/eve/p v/bin/python",
    "a name of two lines": "touch \"$(printf 'a\\nb')\"",
    "a name that is no text": "touch \"$(printf 'a\\377')\"",
    "a FIFO in place of a program": "rm a.py; mkfifo a.py",
    "too much": "truncate -s 10G big || truncate -s 4G big && truncate -s 1G more",
    "what its user cannot read": "mkdir d; touch d/f; chmod 0 d",
    "nothing to enter": 'chmod 0 "$PWD"',
    "settings": "echo 'user: root' >dataflow.systemd.yml",
    "the deep": f"python3 -c '{DEEP}'",
}


@pytest.mark.usefixtures("secret")
def test_what_no_build_may_leave(releases: Releases, eve: Home) -> None:
    for what, build in LEFT.items():
        eve.write("build.sh", build + "\ntrue\n")
        said = releases.deploy(eve.root, "-q", status=5)
        assert "Traceback" not in said, what
        assert len(said.splitlines()) <= 2, (what, said)
        assert not releases.path.exists() or not list(releases.path.iterdir()), what
        assert max(map(len, said.splitlines())) < 700, what
    assert SECRET.read_text() == WORDS
    assert SECRET.stat().st_mode & 0o7777 == 0o600

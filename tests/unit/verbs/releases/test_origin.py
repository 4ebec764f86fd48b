"""Root does not believe a copy more than the original, although the copy is root's."""

import stat
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import Place
from dora_systemd.verbs.start.plan import make_plan
from dora_systemd.verbs.start.read import read_files
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.settings import settings_of

SYSTEM = Scope(is_user=False, uid=0)
RELEASE = "dora-systemd/releases/robot/20261121T220012/tree"


def test_the_owner_of_the_original_counts(tmp_path: Path) -> None:
    (tmp_path / "dataflow.systemd.yml").write_text("user: root\n")
    hers = Place("/home/eve/dataflow.yml", 1000, stat.S_IFREG | 0o644, frozenset({0, 1000}))
    flow = tmp_path / "dataflow.yml"
    flow.write_text("nodes: []\n")
    copy = StartRequest(str(flow), origin=hers)
    with pytest.raises(DoraSystemdError, match="user is set there") as caught:
        settings_of(SYSTEM, read_files(copy), copy)
    assert caught.value.code is ExitCode.NO_PERMISSION
    roots = hers._replace(uid=0, owners=frozenset({0}))
    copy = copy._replace(origin=roots)
    settings = settings_of(SYSTEM, read_files(copy), copy)
    assert "root" in settings.values.values()


def test_a_file_of_a_release_is_not_started(tmp_path: Path) -> None:
    flow = tmp_path / RELEASE / "dataflow.yml"
    flow.parent.mkdir(parents=True)
    flow.write_text("nodes: [{id: a, path: a.py}]\n")
    with pytest.raises(DoraSystemdError, match="it belongs to a release"):
        make_plan(SYSTEM, StartRequest(str(flow)))

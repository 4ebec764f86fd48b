"""Which hosts file -H all believes."""

import os
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.remote import hosts


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "dora-systemd/hosts"
    path.parent.mkdir()
    path.write_text("b\nalice@c\n")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return path


def listed() -> list[str]:
    return [one.text for one in hosts.find_hosts(["all"], os.environ)]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root believes nobody else")
@pytest.mark.parametrize(
    ("mode", "owner", "reason"),
    [
        (0o666, 0, "others than root can write to the file"),
        (0o664, 0, "others than root can write to the file"),
        (0o644, 65534, "the file is not root's"),
        (0o644, 0, ""),
    ],
)
def test_root_believes_what_only_root_can_write(
    file: Path, mode: int, owner: int, reason: str
) -> None:
    file.chmod(mode)
    os.chown(file, owner, 0)
    if not reason:
        assert listed() == ["b", "alice@c"]
        return
    with pytest.raises(DoraSystemdError, match=reason) as caught:
        listed()
    assert caught.value.code is ExitCode.NO_PERMISSION

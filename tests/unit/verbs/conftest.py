"""A scope and a systemd for what the verbs do."""

from pathlib import Path

import pytest

from tests.unit.fakes.manager import FakeManager, ScopeIn


@pytest.fixture
def scope(tmp_path: Path) -> ScopeIn:
    """The system's; tests of a user's have one of their own."""
    return ScopeIn(is_user=False, uid=0, root=tmp_path / "run")


@pytest.fixture
def manager(tmp_path: Path) -> FakeManager:
    """Without units; what it enables is linked below `etc`."""
    manager = FakeManager()
    manager.etc = tmp_path / "etc"
    return manager

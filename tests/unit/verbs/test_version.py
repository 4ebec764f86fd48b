"""doractl version."""

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.version import systemd_version
from tests.unit.fakes.manager import FakeManager

USER = Scope(is_user=True, uid=1000)


def test_systemd_is_found_without_a_manager_of_the_user() -> None:
    def reach(scope: Scope) -> FakeManager:
        if scope.is_user:
            raise DoraSystemdError("cannot reach systemd", "", ExitCode.NO_SYSTEMD)
        return FakeManager()

    assert systemd_version(reach, USER) == FakeManager().version()


def test_a_machine_without_systemd() -> None:
    def reach(_scope: Scope) -> FakeManager:
        raise DoraSystemdError("cannot reach systemd", "", ExitCode.NO_SYSTEMD)

    assert systemd_version(reach, USER) is None

"""What a runner requests of the service that reports failures."""

import os
import threading
from pathlib import Path

import pytest

from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.runner.cell.notices import await_removal, hand_over_ring
from tests.unit.fakes.manager import options, with_texts


@pytest.fixture
def last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The request of a runner that ends for good."""
    directory = tmp_path / "dora-systemd-notice/robot"
    directory.mkdir(parents=True)
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{tmp_path}/dora-systemd/robot:{directory}")
    return directory / "last"


def test_it_waits_until_the_request_is_removed(last: Path) -> None:
    def remove() -> None:
        while not last.exists():
            os.sched_yield()
        last.unlink()

    service = threading.Thread(target=remove)
    service.start()
    await_removal(last, 60)
    service.join()
    assert not last.exists()


def test_no_service_removes_it(last: Path) -> None:
    await_removal(last, 0)
    assert last.exists()


@pytest.mark.parametrize(
    ("texts", "end"),
    [
        (["record=yes"], RunnerExit.NODES_FAILED),
        (["record=yes", "on_failure=/bin/tell"], RunnerExit.NODES_FAILED),
        (["record=yes", "black_box=no"], RunnerExit.NODES_FAILED),
        (["black_box=yes", "restart_policy=on-failure"], RunnerExit.FAILED),
        (["black_box=yes", "restart_policy=on-failure"], None),
        (["black_box=yes", "restart_policy=no"], RunnerExit.OK),
        (["black_box=yes", "restart_policy=no"], None),
    ],
)
def test_what_has_no_bundle_or_another_life_waits_for_nothing(
    last: Path, texts: list[str], end: RunnerExit | None
) -> None:
    hand_over_ring(with_texts(options(), *texts), end)
    assert not last.exists()

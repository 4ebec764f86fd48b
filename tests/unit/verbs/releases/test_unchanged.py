"""A deploy of what runs already."""

from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.decisions.unit.file import with_boot_check
from dora_systemd.verbs.facts.locks import IfInhibited
from dora_systemd.verbs.releases.trial import commit, read_standing
from tests.unit.fakes.deploys import FLOW, UNIT, Bench
from tests.unit.verbs.releases.test_received import FILES, Sender


@pytest.fixture
def sender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sender:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    found = Sender(tmp_path)
    found.how = IfInhibited.REFUSE
    return found


@pytest.fixture
def bench(sender: Sender) -> Bench:
    return sender


def test_what_runs_already_runs_on(bench: Bench) -> None:
    first = bench.deploy()
    lives = bench.manager.lives
    second = bench.deploy()
    assert second == first._replace(copied=0, is_unchanged=True)
    assert (bench.manager.lives, bench.texts, bench.warnings) == (lives, [], [])
    assert bench.releases == {first.release: "current"}
    bench.how = IfInhibited.FORCE
    third = bench.deploy()
    assert (third.former, third.is_unchanged) == (first.release, False)
    assert bench.manager.lives == lives + 1


def test_what_another_host_sends_again_runs_on(sender: Sender) -> None:
    first = sender.send(FILES)
    assert sender.send(FILES) == first._replace(copied=0, is_unchanged=True)
    changed = sender.send({**FILES, "b.py": "print(2)"})
    assert (changed.former, changed.is_unchanged) == (first.release, False)


def test_a_link_counts_by_where_it_leads(bench: Bench) -> None:
    way = bench.project / "way"
    way.symlink_to("a.py")
    bench.deploy()
    assert bench.deploy().is_unchanged
    way.unlink()
    way.symlink_to("dataflow.yml")
    assert not bench.deploy().is_unchanged


def damage(bench: Bench) -> None:
    path = bench.store.tree(*bench.releases) / "a.py"
    path.chmod(0o644)
    path.write_text("x")


def stop(bench: Bench) -> None:
    bench.manager.units[UNIT]["ActiveState"] = "inactive"


def doubt(bench: Bench) -> None:
    bench.store.doubt(*bench.releases)


def edit(bench: Bench) -> None:
    path = bench.manager.paths[1]
    path.write_text(path.read_text().replace("[Service]", "[Service]\nNice=3"))


def link(bench: Bench) -> None:
    path = bench.project / "c.py"
    path.unlink()
    path.symlink_to("a.py")


CHANGES: dict[str, Callable[[Bench], object]] = {
    "a file": lambda bench: bench.write("a.py", "print()"),
    "a new file": lambda bench: bench.write("b.py", ""),
    "one less": lambda bench: (bench.project / "c.py").unlink(),
    "the mode": lambda bench: (bench.project / "c.py").chmod(0o755),
    "a link": link,
    "a setting": lambda bench: bench.write("dora-systemd.yml", "nice: 3\n"),
    "the disk": damage,
    "it does not run": stop,
    "it has not passed": doubt,
    "the unit file": edit,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_differs_is_deployed(bench: Bench, change: Callable[[Bench], object]) -> None:
    bench.write("c.py", "")
    bench.deploy()
    change(bench)
    assert not bench.deploy().is_unchanged


def test_options_count(bench: Bench) -> None:
    bench.deploy(nice=3)
    assert bench.deploy(nice=3).is_unchanged
    assert not bench.deploy(nice=4).is_unchanged


def test_whether_a_boot_starts_it_counts_only_if_it_is_to(bench: Bench) -> None:
    bench.deploy(want_boot=False)
    assert bench.deploy(want_boot=False).is_unchanged
    assert not bench.deploy().is_unchanged
    assert bench.deploy(want_boot=False).is_unchanged


def test_a_boot_check_is_no_difference(bench: Bench) -> None:
    done = bench.deploy()
    standing = read_standing(bench.manager, bench.scope, UNIT)
    text = with_boot_check(bench.store.unit(done.release))
    commit(bench.manager, standing, text, want_boot=False)
    assert bench.deploy().is_unchanged


def test_fewer_releases_to_keep_is_obeyed(bench: Bench) -> None:
    made = []
    for number in range(4):
        bench.write("a.py", f"print({number})")
        made.append(bench.deploy(keep=5).release)
    assert bench.deploy(keep=1).is_unchanged
    assert [*bench.releases] == made[-2:]


def test_the_order_of_the_files_does_not_count(bench: Bench) -> None:
    bench.write("dataflow.yml", FLOW)
    bench.write(".gitignore", "*.log\n")
    bench.deploy()
    bench.write("x.log", "left out")
    assert bench.deploy().is_unchanged

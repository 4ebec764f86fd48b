"""The cell of the only machine of a dataflow changes nothing."""

from pathlib import Path

from dora_systemd.adapters.dora.engine import Child
from dora_systemd.decisions.life.states import State
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.machine_role import Alone
from dora_systemd.runner.cell.restarts import Life
from tests.unit.fakes.dialogue import OPTIONS, Bench
from tests.unit.fakes.loop import live
from tests.unit.fakes.programs import make_program
from tests.unit.runner.cell.test_begin import end

PROGRAM = '{ echo "$@"; env; } >"$0.$1"'


def test_all_is_as_it_is_given() -> None:
    life, options = Life("uuid"), OPTIONS._replace(start_timeout=7)
    alone = Alone(options, life)
    assert (alone.options, alone.this_life, alone.start_timeout) == (options, life, 7)
    assert (alone.sessions, alone.door) == ({}, None)
    assert alone.own(options) is options
    node = {"id": "a"}
    assert alone.definition(node) is node


def test_its_dialogue_is_that_of_the_run(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.BOOTING)
        alone = Alone(OPTIONS, Life("uuid"))
        assert alone.cell(bench.pump.cell) is bench.pump.cell
        given = alone.dialogue(OPTIONS, bench.pump, bench.dora, bench.nodes, bench.pipes)
        assert type(given) is Dialogue
        given.read_coordinator("Listening on port 4711")
        assert (bench.dora.port, len(bench.heard)) == (4711, 1)

    live(work)


class FakeBoot(EarlyDaemon):
    """The daemon of a member, which boots; its coordinator is elsewhere."""

    def _find_port(self) -> int:
        return 0


def coordinator_of(engine: Engine, name: str) -> str:
    """What the engine's coordinator was told."""
    child = Alone(OPTIONS, Life("uuid")).start_coordinator(engine)
    assert isinstance(child, Child)
    assert child.label == "coordinator"
    end(child)
    return Path(f"{name}.coordinator").read_text()


def test_its_dora_is_the_one_of_the_options(tmp_path: Path) -> None:
    async def work() -> None:
        dora = make_program(tmp_path / "dora", PROGRAM)
        paths = CellPaths(tmp_path / "cell")
        paths.root.mkdir()
        alone = Alone(OPTIONS, Life("uuid"))
        given = {"PATH": "/usr/bin:/bin", "MINE": "yes"}
        said = coordinator_of(alone.engine(dora, paths, given, None), dora)
        assert "--port 0" in said
        assert "MINE=yes" in said

    live(work)


def test_a_daemon_that_boots_is_no_coordinator(tmp_path: Path) -> None:
    """Of the two of a member, only the daemon is here."""

    async def work() -> None:
        dora = make_program(tmp_path / "dora", PROGRAM)
        paths = CellPaths(tmp_path / "cell")
        paths.root.mkdir()
        options = OPTIONS._replace(dora=dora)
        boot = FakeBoot(options, paths, tmp_path, {"PATH": "/usr/bin:/bin"})
        engine = Alone(options, Life("uuid")).engine(dora, paths, {"PATH": "/usr/bin:/bin"}, boot)
        assert "--port 0" in coordinator_of(engine, dora)
        assert boot.daemon() is None

    live(work)

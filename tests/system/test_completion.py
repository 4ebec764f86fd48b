"""The Tab key in bash, zsh and fish: the names of what runs, after `doractl setup`."""

import json
from collections.abc import Iterator

import pytest

from tests.system.cells import Cell, run
from tests.system.shells import SHELLS

# `doractl setup` puts the scripts where the shells of everybody look.
pytestmark = pytest.mark.lab


@pytest.fixture(scope="module", autouse=True)
def installed() -> Iterator[None]:
    run("doractl", "setup")
    yield
    run("doractl", "setup", "--remove")


class TestWhatRuns:
    """In each shell."""

    @pytest.mark.parametrize("shell", SHELLS)
    def test_dataflows_and_nodes(self, shell: str, running: Cell) -> None:
        ask = SHELLS[shell]
        begun = running.name[:-1]
        for verb in ("stop", "node restart", "logs --follow"):
            assert ask(f"doractl {verb} {begun}", ()) == [running.name]
        (row,) = json.loads(running.doractl("list", "-o", "json").stdout)
        assert ask(f"doractl --system show {row['uuid'][:8]}", ()) == [row["uuid"]]
        assert ask(f"doractl node restart {running.name} so", ()) == ["source"]
        nodes = f"doractl logs {running.name} --node d"
        assert ask(nodes, ()) == ["doubler"], f"bash: {SHELLS['bash'](nodes, ())}"
        assert running.name not in ask(f"doractl stop {running.name} {begun}", ()), "given already"
        assert ask("doractl sto", ()) == ["stop"]
        (level,) = ask("doractl logs --level=w", ())
        assert level.removeprefix("--level=") == "warn"
        if shell != "bash":
            assert level != "warn", "it would replace the option"

    def test_what_has_stopped(self, running: Cell) -> None:
        """The last one: no shell offers it again."""
        running.doractl("stop", running.name)
        for ask in SHELLS.values():
            assert running.name not in ask("doractl stop ", ())

"""The dora command: which one, and which version."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.dora import command
from dora_systemd.errors import DoraSystemdError, ExitCode
from tests.unit.fakes.programs import make_program


def test_a_script_whose_interpreter_is_gone(tmp_path: Path) -> None:
    """As in an environment that was moved."""
    dora = tmp_path / "dora"
    dora.write_text("#!/nowhere/bin/python\n")
    dora.chmod(0o755)
    with pytest.raises(DoraSystemdError, match=f"cannot run {dora}: No such file") as caught:
        command.dora_version(str(dora))
    assert (caught.value.code, caught.value.hint) == (ExitCode.NO_DORA, command.INSTALL_HINT)


def test_dora_is_told_to_print_plainly(tmp_path: Path) -> None:
    dora = make_program(tmp_path / "dora", 'echo "$NO_COLOR $RUST_BACKTRACE $1"')
    assert command.run_dora(dora, ["validate"], None, {}).stdout == "1 0 validate\n"


def test_dora_given_wins_over_venv_and_path(tmp_path: Path) -> None:
    given_dora, venv, other = (
        make_program(tmp_path / place / "dora", "") for place in ("given", "venv/bin", "other")
    )
    search_path = str(Path(other).parent)
    environment = str(tmp_path / "venv")
    assert command.find_dora(given_dora, environment, search_path) == given_dora
    assert command.find_dora(None, environment, search_path) == venv
    assert command.find_dora(None, None, search_path) == other


def test_dora_beside_our_own_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As pip has installed both; PATH wins over it."""
    own, other = (make_program(tmp_path / place / "dora", "") for place in ("own", "other"))
    monkeypatch.setattr("sys.executable", str(tmp_path / "own/python3"))
    assert command.find_dora(None, None, "/nowhere") == own
    assert command.find_dora(None, None, str(tmp_path / "other")) == other


@pytest.mark.parametrize("given_dora", [None, "/nowhere/dora"])
def test_no_dora(given_dora: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/nowhere/python3")
    with pytest.raises(DoraSystemdError) as caught:
        command.find_dora(given_dora, None, "/nowhere")
    assert caught.value.code is ExitCode.NO_DORA
    assert "pip install" in caught.value.hint


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("echo dora-cli 0.5.0", "it is dora 0.5.0"),
        ("echo something else", "something else"),
        ("exit 1", "it tells no version"),
    ],
)
def test_a_dora_that_is_none(tmp_path: Path, script: str, reason: str) -> None:
    dora = make_program(tmp_path / "dora", script)
    with pytest.raises(DoraSystemdError, match=reason) as caught:
        command.dora_version(dora)
    assert caught.value.code is ExitCode.NO_DORA


def test_version(tmp_path: Path) -> None:
    assert command.dora_version(make_program(tmp_path / "dora", "echo dora-cli 1.1.0")) == "1.1.0"


@given(st.text())
def test_any_text_has_a_version_or_none(text: str) -> None:
    version = command.parse_dora_version(text)
    assert version is None or command.version_numbers(version)


@pytest.mark.parametrize("end", ["9", "x"])
def test_a_version_has_a_bound(end: str) -> None:
    """The program may be another user's, and root may ask."""
    text = "dora 1.1" + end * 5000
    assert command.parse_dora_version(text) is None
    assert command.version_numbers(text.removeprefix("dora "))[:1] == (1,)

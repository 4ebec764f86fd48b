"""Flags of settings on the command line."""

import click
import pytest
from click.testing import CliRunner

from dora_systemd.cli.setting_options import SettingsCommand, setting_options


@click.command(cls=SettingsCommand)
@setting_options
def verb(**values: object) -> None:
    """Print what was given."""
    print(values["exit_when_nodes_finish"])


@pytest.mark.parametrize(
    ("words", "value"),
    [
        ([], "None"),
        (["--exit-when-nodes-finish"], "True"),
        (["--exit-when-nodes-finish=true"], "True"),
        (["--exit-when-nodes-finish=false"], "False"),
        (["--no-exit-when-nodes-finish"], "False"),
    ],
)
def test_a_flag_with_a_value_as_dora_writes_it(words: list[str], value: str) -> None:
    assert CliRunner().invoke(verb, words).output == f"{value}\n"


def test_a_flag_with_another_value_is_refused() -> None:
    assert CliRunner().invoke(verb, ["--exit-when-nodes-finish=perhaps"]).exit_code

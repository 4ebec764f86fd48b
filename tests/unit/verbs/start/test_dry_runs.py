"""`start --dry-run` of the examples, compared with what it was."""

from pathlib import Path

import pytest

from tests.dry_runs import CASES, UNITS, dry_run


@pytest.mark.parametrize("name", CASES)
def test_the_unit_is_what_it_was(name: str, tmp_path: Path) -> None:
    expected = (UNITS / f"{name}.txt").read_text()
    assert dry_run(CASES[name], tmp_path) == expected, "if meant: python3 -m tests.dry_runs"

"""An ssh that logs in to this machine, where doractl is a script."""

import os
from pathlib import Path

import pytest

from tests.unit.fakes.programs import make_program


def fake_ssh(patch: pytest.MonkeyPatch, directory: Path, doractl: str) -> Path:
    """From now on ssh runs its command here, with the text of this doractl: the home there.

    $HOST is the host that it has been called with.
    """
    place, home = directory / "bin", directory / "there"
    home.mkdir()
    login = f'export HOME={home}; while [ "$1" != -- ]; do shift; done; export HOST="$2"'
    make_program(place / "ssh", f'{login}; exec sh -c "$3"')
    make_program(place / "doractl", doractl)
    patch.setenv("PATH", f"{place}:{os.environ['PATH']}")
    return home

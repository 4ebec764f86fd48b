"""Which files a program is made of."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.reload.imports import program_files, syntax_error

FILES = {
    "/p/camera.py": "import os\nimport lens\nfrom shared import colors as c, other\n",
    "/p/lens.py": "def f():\n    from . import x\n    import deep.down.here\n",
    "/p/shared/__init__.py": "",
    "/p/shared/colors.py": "from .tables import RGB\nfrom .. import top\n",
    "/p/shared/tables.py": "import camera",
    "/p/deep/__init__.py": "",
    "/p/deep/down/__init__.py": "",
    "/p/deep/down/here.py": "",
    "/p/top.py": "",
    "/p/lonely.py": "import camera",
    "/p/broken.py": "def (",
}


def files(script: str) -> set[str]:
    return {path.removeprefix("/p/") for path in program_files(script, FILES.get)}


@pytest.mark.parametrize(
    ("script", "expected"),
    [
        (
            "/p/camera.py",
            "camera.py lens.py shared/__init__.py shared/colors.py shared/tables.py "
            "deep/__init__.py deep/down/__init__.py deep/down/here.py top.py",
        ),
        ("/p/top.py", "top.py"),
        ("/p/broken.py", "broken.py"),
        ("/p/not-there.py", ""),
    ],
)
def test_files_of_a_program(script: str, expected: str) -> None:
    assert files(script) == set(expected.split())


def test_who_imports_all_is_made_of_all() -> None:
    assert files("/p/lonely.py") == files("/p/camera.py") | {"lonely.py"}


@given(st.text())
def test_any_source_is_read(source: str) -> None:
    assert program_files("/p/a.py", {"/p/a.py": source}.get) == {"/p/a.py"}


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("x = 1\n", ""),
        ("x = 1\ndef (\n", "line 2: invalid syntax"),
    ],
)
def test_syntax(source: str, error: str) -> None:
    assert syntax_error("/p/a.py", source) == error


@pytest.mark.parametrize("source", ["-" * 100_000 + "1", "+".join(["1"] * 20_000)])
def test_a_source_that_python_cannot_hold(source: str) -> None:
    assert program_files("/p/a.py", {"/p/a.py": source}.get) == {"/p/a.py"}
    assert syntax_error("/p/a.py", source)

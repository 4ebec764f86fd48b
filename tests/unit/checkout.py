"""Where the sources are, and the package as it is when it is installed."""

import ast
from functools import cache
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]


@cache
def module_paths() -> dict[str, Path]:
    """Every module of ours by name without "dora_systemd.", such as "values" and "cli.main"."""
    package = CHECKOUT / "dora_systemd"
    found = {path.relative_to(package).with_suffix(""): path for path in package.rglob("*.py")}
    own = {".".join(name.parts): path for name, path in found.items()}
    command = {path.relative_to(CHECKOUT): path for path in (CHECKOUT / "cli").rglob("*.py")}
    cli = {".".join(name.with_suffix("").parts): path for name, path in command.items()}
    return {name: path for name, path in (own | cli).items() if not name.endswith("__init__")}


@cache
def tree_of(name: str) -> ast.Module:
    """The syntax tree of a module of ours."""
    return ast.parse(module_paths()[name].read_text())


@cache
def nodes_of(name: str) -> tuple[ast.AST, ...]:
    """All nodes of its tree: several tests search them."""
    return tuple(ast.walk(tree_of(name)))


def linked_package(place: Path) -> Path:
    """`place` with the packages where their names say they are, by links.

    `dora_systemd.cli` is the directory `cli` only for setuptools and what it has installed.
    """
    package = place / "dora_systemd"
    package.mkdir(parents=True, exist_ok=True)
    wanted = {path.name: path for path in (CHECKOUT / "dora_systemd").iterdir()}
    wanted["cli"] = CHECKOUT / "cli"
    for link in package.iterdir():
        if link.name not in wanted:
            link.unlink()
    for name, path in wanted.items():
        if not (package / name).is_symlink():
            (package / name).symlink_to(path)
    others = {"tests": "tests", "lab": "tests/lab", "benchmarks": "benchmarks"}
    for name, path in {name: CHECKOUT / path for name, path in others.items()}.items():
        if not (place / name).is_symlink():
            (place / name).symlink_to(path)
    return place

"""What root believes of a copy that another user has read for it."""

from pathlib import Path

import pytest

from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.source import Source, find_source, named_paths, require_same
from dora_systemd.verbs.start.request import StartRequest
from tests.unit.fakes.programs import make_program

USER = Scope(is_user=True, uid=1000)
FLOW, SETTINGS, VARIABLES = "dataflow.yml", "dataflow.systemd.yml", "robot.env"
TEXT = "nodes: [{id: a, path: a.py}]\n"


def source_of(root: Path) -> Source:
    (root / "a.py").write_text("")
    dora = make_program(root.parent / "bin/dora")
    return find_source(USER, StartRequest(str(root), flags={"dora": dora}))


def test_no_project_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever has named no file cannot correct its path."""
    monkeypatch.chdir(tmp_path)
    for given, hint in (("dataflow.yml", "go to the directory"), (str(tmp_path), "correct the")):
        with pytest.raises(DoraSystemdError, match=f"{tmp_path}/dataflow.yml: there is") as caught:
            find_source(USER, StartRequest(given))
        assert caught.value.hint.startswith(hint)


@pytest.mark.parametrize("name", [FLOW, SETTINGS, VARIABLES])
@pytest.mark.parametrize("lie", ["A=2\n", None])
def test_a_copy_says_the_same(tmp_path: Path, name: str, lie: str | None) -> None:
    here, tree = tmp_path / "here", tmp_path / "tree"
    for place in (here, tree):
        place.mkdir()
        (place / FLOW).write_text(TEXT)
        (place / SETTINGS).write_text(f"env_file: {VARIABLES}\n")
        (place / VARIABLES).write_text("A=1\n")
    source = source_of(here)
    require_same(source, tree)
    if lie is None:
        (tree / name).unlink()
    else:
        (tree / name).write_text(lie)
    with pytest.raises(DoraSystemdError, match=f"cannot copy {name}: it changed"):
        require_same(source, tree)


def test_settings_that_only_the_copy_has(tmp_path: Path) -> None:
    (tmp_path / FLOW).write_text(TEXT)
    source = source_of(tmp_path)
    tree = tmp_path / "tree"
    tree.mkdir()
    (tree / FLOW).write_text(TEXT)
    require_same(source, tree)
    (tree / SETTINGS).write_text("user: root\n")
    with pytest.raises(DoraSystemdError, match="it changed"):
        require_same(source, tree)


CLONE = "nodes: [{id: a, path: robot-camera}]\n"


def clone_of(tmp_path: Path, activated: str = "") -> Source:
    """A project with uv.lock that was never built. activated: the caller's VIRTUAL_ENV."""
    root = tmp_path / "clone"
    root.mkdir()
    (root / FLOW).write_text(CLONE)
    (root / "uv.lock").write_text("version = 1\n")
    environment = {"PATH": str(tmp_path / "bin"), "VIRTUAL_ENV": activated}
    dora = make_program(tmp_path / "dora")
    return find_source(USER, StartRequest(str(root), None, {"dora": dora}, environment))


def test_uv_makes_the_programs_of_a_clone(tmp_path: Path) -> None:
    uv = make_program(tmp_path / "bin/uv")
    make_program(tmp_path / "other/bin/python")
    source = clone_of(tmp_path, str(tmp_path / "other"))
    assert (source.uv, source.dora) == (uv, "")
    assert source.own_venv == ".venv"  # and not the activated one


def test_nothing_makes_the_programs_of_a_clone_without_uv(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError, match=r"'robot-camera' is neither in") as caught:
        clone_of(tmp_path)
    assert f"run `doractl build {tmp_path}/clone/{FLOW}` first" in str(caught.value.hint)


def test_what_a_dataflow_names_belongs_to_its_release() -> None:
    """Also what git does not track, and .gitignore leaves out."""
    nodes = [
        {"id": "a", "path": "a.py"},
        {"id": "b", "path": "../b.py"},
        {"id": "c", "path": "/usr/bin/c"},
        {"id": "d", "path": "https://host/d"},
        {"id": "e", "module": "e.yml"},
        {"id": "f", "operator": {"python": "f.py"}},
        {"id": "g", "operators": [{"id": "x", "python": {"source": "g.py"}}, {"id": "y"}]},
        {"id": "h", "path": "a.py"},
    ]
    dataflow = parse_dataflow({"nodes": nodes}, "/r/flows/x.yml")
    found = named_paths(dataflow, "/r/work", "/r", ("/r/x.env", "/other/y.env", "/r2/z.env"))
    assert found == (
        *("flows/x.yml", "flows/x.systemd.yml", "work/a.py", "b.py"),
        *("work/e.yml", "work/f.py", "work/g.py", "x.env"),
    )


@pytest.mark.parametrize(
    ("module", "is_built"),
    [
        ("nodes: [{id: a, path: a.py, build: make}]\n", True),
        ("nodes: [{id: a, path: a.py}]\n", False),
        ("nodes: {", False),
    ],
)
def test_a_build_that_only_a_module_asks_for(tmp_path: Path, module: str, is_built: bool) -> None:
    (tmp_path / FLOW).write_text("nodes: [{id: m, module: m.yml}, {id: b, path: a.py}]\n")
    (tmp_path / "m.yml").write_text(module)
    source = source_of(tmp_path)
    assert bool(source.dora) is is_built
    assert (source.uv, source.is_moving) == ("", is_built)

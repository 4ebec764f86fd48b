"""What a node sees under `doractl run` is what it sees under `dora run`."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.canary import help_tree
from tests.system.cells import Cell, Project, run

PROBE = """
import json, os, sys
seen = {"argv": sys.argv, "cwd": os.getcwd(), "env": dict(os.environ)}
status = open("/proc/self/status").read()
seen["ignored"] = int(status.split("SigIgn:")[1].split()[0], 16) >> 31
with open(os.path.join("SEEN", os.environ["PROBE"]), "w") as file:
    json.dump(seen, file)
from dora import Node
Node()
"""
ARGUMENTS = {
    "block": "|\n      --one \\\n      --two 'a b'\n      last",
    "dollar": '\'"a\\$b" $HOME "$HOME"\'',
    "backquote": "'\"a`b\"'",
    "comment": "'--colour #ff0000'",
    "hash": "'a#b'",
    "return": '"a\\rb c"',
    "escapes": '\'"x\\ny" a\\ b "\\\\"\'',
    "float": "1.50",
    "zeros": "007",
    "hex": "0x10",
    "power": "1e3",
    "true": "true",
    "empty": "\"'' x\"",
}
VARIABLES: dict[str, dict[str, object]] = {
    "names": {"node": "camera", "directory": "/d", "output": "o", "last": "l", "IFS": "x"},
    "odd": {"my.var": "1", "MY-VAR": "2", "a b": "3", "OPTIND": "7", "OLDPWD": "/old"},
    "numbers": {"A": 1.50, "B": 16, "C": 1000.0, "D": "1.10", "E": "007", "F": True, "G": "1e3"},
    "texts": {"A": "a b", "B": "ü", "C": "x\ny", "D": "", "E": "#x", "F": "~", "G": "no"},
    "infinite": {"A": "inf", "B": "-Infinity", "C": "NaN", "D": "1e999", "E": "infinite"},
    "price": {"A": "$$", "B": "a$$b", "C": "$$HOME", "D": "$$$$"},
    "caller": {"A": "${FROM_CALLER}", "B": "x$FROM_CALLER.y"},
}
PATHS = {"dots": "../project/probe.py", "here": "./probe.py", "link": "link.py", "exe": "probe"}
OWN = frozenset(("DORA_NODE_CONFIG", "PROBE"))


@pytest.fixture
def flow(project: Project) -> Path:
    """A dataflow with a node for each case; each writes down what it sees, and ends."""
    seen = project.root / "seen"
    seen.mkdir()
    for path in (project.root, seen):
        shutil.chown(path, "alice", "alice")
    project.write("probe.py", PROBE.replace("SEEN", str(seen)))
    (project.root / "link.py").symlink_to("probe.py")
    project.write("probe", "#!/usr/bin/env python3\n" + PROBE.replace("SEEN", str(seen)))
    (project.root / "probe").chmod(0o755)
    nodes = [
        f"  - id: args-{name}\n    path: probe.py\n    args: {text}\n"
        f"    env: {{PROBE: args-{name}}}\n"
        for name, text in ARGUMENTS.items()
    ]
    for name, program in PATHS.items():
        nodes.append(f"  - {{id: path-{name}, path: {program}, env: {{PROBE: path-{name}}}}}\n")
    for name, variables in VARIABLES.items():
        env = json.dumps({**variables, "PROBE": f"env-{name}"}, ensure_ascii=False)
        nodes.append(f"  - id: env-{name}\n    path: probe.py\n    env: {env}\n")
    return project.write("dataflow.yml", "nodes:\n" + "".join(nodes))


def seen_with(flow: Path, *command: str) -> dict[str, Any]:
    """What the nodes wrote down, by case, when alice runs the dataflow."""
    out = flow.parent / "seen"
    words = " ".join(command)
    script = f"cd {flow.parent} && FROM_CALLER=yolo RUST_LOG=warn exec {words} {flow}"
    run("su", "alice", "-s", "/bin/sh", "-c", script)
    found = {path.name: json.loads(path.read_text()) for path in sorted(out.iterdir())}
    for path in out.iterdir():
        path.unlink()
    return found


def test_arguments_directory_and_environment(flow: Path) -> None:
    bare = seen_with(flow, "dora", "run")
    ours = seen_with(flow, "doractl", "run", "--name", "fidelity")
    cases = [node["id"] for node in yaml.safe_load(flow.read_text())["nodes"]]
    assert sorted(bare) == sorted(cases)
    for case in cases:
        assert ours[case]["argv"] == bare[case]["argv"], case
        assert ours[case]["cwd"] == bare[case]["cwd"], case
        assert ours[case]["ignored"] == 0, "signals of glibc"  # dora leaves what su had
    assert ours["path-here"]["env"]["RUST_LOG"] == bare["path-here"]["env"]["RUST_LOG"] == "warn"
    for name, variables in VARIABLES.items():
        case = f"env-{name}"
        keys = variables.keys() - OWN
        assert chosen(ours[case], keys) == chosen(bare[case], keys), case


@pytest.mark.parametrize("way", ["../link", "seen/.."])
def test_the_directory_is_resolved(flow: Path, way: str) -> None:
    (flow.parent.parent / "link").symlink_to(flow.parent)
    path = flow.parent / way / flow.name
    bare = seen_with(path, "dora", "run")
    ours = seen_with(path, "doractl", "run", "--name", "fidelity")
    assert f"{flow.parent}/probe.py" in bare["args-hash"]["argv"]
    for case, seen in bare.items():
        assert (ours[case]["argv"], ours[case]["cwd"]) == (seen["argv"], seen["cwd"]), case


def test_infinite_numbers_of_yaml(flow: Path) -> None:
    flow.write_text(
        "nodes: [{id: one, path: probe.py, env: {PROBE: one, A: .inf, B: -.inf, C: .nan}}]\n"
    )
    bare = seen_with(flow, "dora", "run")["one"]
    ours = seen_with(flow, "doractl", "run", "--name", "fidelity")["one"]
    assert chosen(ours, {"A", "B", "C"}) == chosen(bare, {"A", "B", "C"})


def chosen(seen: dict[str, Any], keys: set[str]) -> dict[str, str | None]:
    return {key: seen["env"].get(key) for key in sorted(keys)}


@pytest.mark.warns("names a variable that is not set", "'exit-code'", "Failed to start dora-")
@pytest.mark.parametrize("owner", ["alice", "root"])
def test_variables_of_root_are_for_files_of_root(flow: Path, cell: Cell, owner: str) -> None:
    """A file of alice's could read out any variable of root's."""
    flow.write_text("nodes: [{id: one, path: probe.py, env: {PROBE: one, A: '${CALLER}'}}]\n")
    project = flow.parent
    for path in (project, flow, project / "probe.py"):
        shutil.chown(path, owner, owner)
    (project / "seen").chmod(0o777)
    environment = {**os.environ, "CALLER": "secret"}
    words = ("run", str(flow), "--name", cell.name, "--writable", str(project / "seen"))
    done = run("doractl", "--system", *words, env=environment, check=False)
    assert done.returncode == (0 if owner == "root" else 5), done.stderr
    if owner == "root":
        assert json.loads((project / "seen/one").read_text())["env"]["A"] == "secret"
    else:
        assert "names a variable that is not set" in done.stderr
        assert "secret" not in done.stdout + done.stderr


def test_dora_has_the_commands_and_options_of_the_stored_tree() -> None:
    """`make canary` shows what another dora has; the tree is of the one that the tests run with."""
    assert help_tree.differences("dora") == []

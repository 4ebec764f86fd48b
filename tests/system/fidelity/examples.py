"""dora's own examples do the same under `dora run` and `doractl run`. By hand: see HACKING.md.

Only those made of Python, whose programs are in their directory. What they need to be built is not
installed: those that miss a package must fail both ways.
"""

import os
import re
import shutil
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project
from tests.system.fidelity.test_generated import FAILURES
from tests.system.fidelity.ways import Done, lines_of, run_both
from tests.system.tolerated import is_tolerated

ROOT = Path(os.environ["DORA_EXAMPLES"])
_PROGRAM = re.compile(r"^[ -]*(?:path|python|shared-library|hub): *(\S+)", re.M)
_BUILD = re.compile(r"^ *build:.*\n", re.M)
_CHANGING = re.compile(r"[0-9a-f]{8}-[0-9a-f-]+|[0-9a-f]*\d[0-9a-f.]*")


def is_python(flow: Path) -> bool:
    """Whether all programs of a dataflow are Python files beside it."""
    programs = [flow.parent / name for name in _PROGRAM.findall(flow.read_text())]
    return bool(programs) and all(one.suffix == ".py" and one.is_file() for one in programs)


EXAMPLES = [str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("*/*.yml")) if is_python(path)]


@pytest.mark.warns("", *FAILURES)
@pytest.mark.parametrize("example", EXAMPLES)
def test_example(cell: Cell, project: Project, example: str) -> None:
    shutil.copytree((ROOT / example).parent, project.root, dirs_exist_ok=True)
    flow = project.write(Path(example).name, _BUILD.sub("", (ROOT / example).read_text()))
    bare, ours = run_both(flow, cell, {}, "--stop-after", "8s")
    print(bare.stdout, bare.stderr, ours.stdout, ours.stderr, sep="\n")
    assert (ours.returncode != 0, said(ours)) == (bare.returncode != 0, said(bare))


def said(done: Done) -> set[tuple[str, str]]:
    """Node and line, without numbers, and without what depends on the speed of the machine."""
    lines = {(node, line) for node, line in lines_of(done.stdout) if not is_tolerated(line)}
    return {(node, _CHANGING.sub("#", line)) for node, line in lines}

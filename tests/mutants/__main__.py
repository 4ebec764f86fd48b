"""Changes the product in one place at a time, and counts how many changes unit tests notice.

mutmut makes the changes, the mutants, in a private copy of the checkout, and runs for each only the
tests of FOLDERS that call the changed function. A run of all mutants takes hours, so SAMPLE of them
are chosen by SEED.
"""

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.mutants.kept import find_reason
from tests.mutants.outcome import Mutant, count, format_table, percent, read_change, read_mutants

CHECKOUT = Path(__file__).resolve().parents[2]
FOLDERS = (
    *("decisions/life", "decisions/releases", "decisions/logs", "decisions/why"),
    *("trust", "verbs/releases", "adapters/logs", "runner/cell"),
)
# The text of these is an argument of a child process, which has no mutmut; and with all mutants
# in it, the text is longer than execve(2) takes.
TEXTS = ("trust/courier.py", "trust/eyes.py", "trust/scribe.py")
LEAST_PERCENT = 85.0
PLACE = Path("/var/tmp")  # not below /tmp, which is another one for the mutants
_NONE = "no mutant has this name"
_STATS = "mutmut-stats.json"
_IGNORED = (".*", "__pycache__", "dist")
# A mutant is root and may do anything: all but the copy is read-only, and /tmp and /var/tmp are its
# own. mutmut sends a signal to the number of each process that may hang, also when another program
# has that number, so it gets numbers of its own; this sh(1) reaps the orphans.
_APART = ("unshare", "--pid", "--fork", "--kill-child", "--mount-proc")
_INSIDE = """set -e
mount --bind . . && mount --bind . "var-tmp/${PWD##*/}" && mount --rbind var-tmp "${PWD%/*}"
mount --bind tmp /tmp && mount -o remount,bind,ro /
cd "$PWD"
mutmut run --max-children 1 "$@"; exit $?
"""


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="tests.mutants")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sample", type=int, default=1000)
    parser.add_argument("folders", nargs="*", default=FOLDERS)
    chosen = parser.parse_args(arguments)
    tree = PLACE / f"dora-systemd-mutants-{os.getpid()}"
    try:
        prepare(tree, chosen.folders)
        return run(tree, chosen.seed, chosen.sample)
    finally:
        # A mutant may leave directories deeper than shutil.rmtree() can go.
        subprocess.run(["rm", "-rf", "--one-file-system", str(tree)], check=False)


def prepare(tree: Path, folders: Sequence[str]) -> None:
    """Copy the checkout to `tree`, with what mutmut is to do there."""
    ignore = shutil.ignore_patterns(*_IGNORED)
    shutil.copytree(CHECKOUT, tree, symlinks=True, ignore=ignore)
    (tree / "dora_systemd/cli").symlink_to("../cli")
    also = [one.name for one in tree.iterdir() if one.name not in ("dora_systemd", "tests")]
    lines = {
        "source_paths": ["dora_systemd"],
        "only_mutate": [f"dora_systemd/{folder}/*" for folder in folders],
        "do_not_mutate": [f"dora_systemd/{path}" for path in TEXTS],
        "also_copy": also,
        "pytest_add_cli_args": ["-p", "no:xdist", "-p", "tests.mutants.fresh"],
        "pytest_add_cli_args_test_selection": [f"tests/unit/{folder}" for folder in folders],
        "use_setproctitle": ["false"],
    }
    text = "".join("\n    ".join([f"{key} =", *values]) + "\n" for key, values in lines.items())
    (tree / "setup.cfg").write_text(f"[mutmut]\n{text}")
    (tree / "mutants").mkdir()  # Python takes no path of PYTHONPATH that comes later
    (tree / "var-tmp" / tree.name).mkdir(parents=True)
    (tree / "tmp").mkdir()
    for name in ("tmp", "var-tmp"):
        (tree / name).chmod(0o1777)


def run(tree: Path, seed: int, sample: int) -> int:
    """Run a sample of the mutants, and print what has become of them."""
    place = tree / "mutants"
    # Makes all mutants, learns which tests call which function, and fails for want of a mutant.
    call_mutmut(tree, [_NONE], place / _STATS)
    everything = read_mutants(place)
    add_tests(place / _STATS, everything)
    names = [one.name for one in everything]
    chosen = set(random.Random(seed).sample(names, min(sample, len(names))))
    print(f"{len(chosen)} of {len(names)} mutants, SEED={seed}", flush=True)
    call_mutmut(tree, sorted(chosen))
    mutants = [one for one in read_mutants(place) if one.name in chosen and one.outcome]
    for mutant in mutants:
        if mutant.outcome == "survived":
            change = read_change(place, CHECKOUT, mutant)
            print(f"{mutant.path}:{change.line}: {change.before}  ->  {change.after}")
            if reason := find_reason(str(mutant.path), change.before, change.after):
                print(f"    stays: {reason}")
    print(format_table(mutants))
    return 0 if percent(count(mutants)) >= LEAST_PERCENT else 1


def add_tests(file: Path, mutants: Sequence[Mutant]) -> None:
    """Give each function the tests of its module, too.

    mutmut sees no call in a child process, and none while pytest collects the tests.
    """
    stats = json.loads(file.read_text())
    known, durations = stats["tests_by_mangled_function_name"], stats["duration_by_test"]
    for mutant in mutants:
        function = re.sub(r"__mutmut_\d+$", "", mutant.name)
        tests = f"tests/unit/{mutant.folder}/test_{mutant.path.name}::"
        own = (test for test in durations if test.startswith(tests))
        known[function] = list(dict.fromkeys([*known.get(function, []), *own]))
    file.write_text(json.dumps(stats))


def call_mutmut(tree: Path, names: Sequence[str], made: Path | None = None) -> None:
    """Run the mutants of these names. Ends this program if that fails, and `made` is not there."""
    env = {
        **os.environ,
        "PYTHONPATH": f"{tree}/mutants",
        "PYTHONPYCACHEPREFIX": f"{tree}/pycache",
        "HYPOTHESIS_STORAGE_DIRECTORY": f"{tree}/hypothesis",
        "PYTEST_ADDOPTS": f"-o cache_dir={tree}/pytest",  # all else is read-only
    }
    with (tree / "mutmut.log").open("w") as log:
        command = ["nice", "-n", "15", *_APART, "sh", "-c", _INSIDE, "sh", *names]
        done = subprocess.run(command, cwd=tree, env=env, stdout=log, stderr=log, check=False)
    if done.returncode and not (made and made.exists()):
        sys.exit((tree / "mutmut.log").read_text(errors="replace")[-4000:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

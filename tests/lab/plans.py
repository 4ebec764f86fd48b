"""What the steps of `make test` and its parts are."""

import atexit
import os
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from lab.cache import find_cache
from lab.changed import changed_rooms
from lab.definition import CHECKOUT, NEW_SUITE, OLD_SUITE, PLATFORMS
from lab.errors import LabError
from lab.marked import marked_files
from lab.options import FOREIGN, MACHINES
from lab.process import need_root
from lab.steps import Step, run_steps
from lab.venv import add_package, ensure_venv, venv_environment

LAB_PYTHON = (3, 13)
MUTMUT = "mutmut==3.8.1"
# xdist would name its processes with it, and some tests look at their own command line.
NOT_WITH_MUTMUT = "setproctitle"
FAULTS = "tests/system/faults"
TRANSCRIPTS = "tests/system/transcripts"
# What `make test` types of them on other releases of Debian.
TYPED = [f"{TRANSCRIPTS}/test_transcripts.py::test_task[{one}]" for one in ("first-start", "typo")]
# System tests that need no image or kernel of their own.
IN_CONTAINER = "not vm and not emulator and not openarm"
# Containers at the same time. Most of the time of a test is waiting: three leave processors idle.
CONTAINERS = 4
# A step that takes so many times longer than it should hangs: it fails, and the others are shown.
# A machine may have half of the speed, and images are built in the minutes of the first that asks.
PATIENCE = 5
LEAST_LONGEST = 40
# Unit tests that need mandoc, fish, zsh, mcap or pyarrow, which the lab has.
WITH_TOOLS = (
    "tests/unit/cli/test_completions.py",
    "tests/unit/decisions/dora/test_command.py",
    "tests/unit/decisions/recorder/test_mcap.py",
    "tests/unit/project/test_manpages.py",
)
# Stops between two restarts of a machine, which come after other kinds of stops each time.
STAGE = 9
# What `make test` runs on the next Debian: what differs there.
NEW = "versions or doctor or units or life or newer or account or ordinary or pip or task"
# Far more than any test takes: one that hangs fails and shows where, and the others run.
PYTEST = ("pytest", "--timeout=900")
# A unit test that hangs holds up its whole step, and none takes a tenth of this.
UNIT = ("pytest", "--timeout=300", "tests/unit")
# A dataflow as a service, from start to stop: what to run after every change.
QUICK = (
    *("cell", "start", "bus", "lab", "stop", "list", "kinds"),
    *("start_refused", "start_run", "cli", "stack"),
)


def main(arguments: Sequence[str]) -> int:
    form = os.environ.get("LAB") or "container"
    try:
        plan = PLANS[arguments[0]]
        os.environ["LAB"] = form
        return run_steps(plan(form))
    except LabError as error:
        print(error, file=sys.stderr)
        return 125
    except KeyboardInterrupt:
        return 130


def plan_test(form: str) -> list[Step]:
    if form == "host":
        return [*plan_unit(form), *plan_system(form)]
    (unit,) = plan_unit(form)
    # The unit tests, which all others wait for, leave it a third of a processor.
    build = replace(build_step(), after=())
    inside, several = limits_step(), machines_steps()
    # What they take beside all others.
    queue = [replace(one, after=(unit.name,), minutes=21) for one in plan_system("container")]
    several = [replace(one, after=(unit.name,), minutes=12) for one in several]
    inside = replace(inside, after=(unit.name,))
    restarted = replace(reboot_step(), after=(build.name, inside.name))
    arm = replace(openarm_step(), after=(restarted.name,))
    oldest, newest = platform_step(OLD_SUITE, minutes=2), platform_step(NEW_SUITE, "-k", NEW)
    lane = [packages_step(), wheels_step(), oldest, newest, *plan_lab(form)]
    others = [*plan_other_python(form), *plan_emulator(form)]
    # The machines have the longest way, nearly all of it waiting, so nothing is before them.
    plan = [unit, *several, build, *in_a_row(lane, build)]
    plan += [inside, restarted, arm, *in_a_row(others, arm), *queue]
    return [replace(one, longest=max(LEAST_LONGEST, PATIENCE * one.minutes)) for one in plan]


def in_a_row(steps: Sequence[Step], first: Step) -> list[Step]:
    """The steps one after the other, from the end of `first` on."""
    before = [first, *steps]
    return [replace(one, after=(last.name,)) for last, one in zip(before, steps, strict=False)]


def in_venv(for_system_tests: bool = False) -> dict[str, str]:
    return venv_environment(ensure_venv(find_cache(), for_system_tests))


def in_lab(form: str) -> Callable[[], dict[str, str]]:
    return lambda: {**os.environ, "LAB": form}


def plan_unit(_form: str) -> list[Step]:
    return [unit_step([])]


def plan_check(_form: str) -> list[Step]:
    """Linters, types and unit tests, those of what has changed first; or what PYTEST names."""
    chosen = shlex.split(os.environ.get("PYTEST", ""))
    if chosen:
        return [Step("unit tests", ["python", "-m", "pytest", *chosen], in_venv)]
    return [unit_step([f"--first={','.join(changed_rooms())}"])]


def unit_step(options: Sequence[str]) -> Step:
    """One more worker than processors, since tests wait now and then for a child or a timeout.

    A worker that has no tests left takes over some of another's.
    """
    workers = str((os.cpu_count() or 1) + 1)
    command = ["python", "-m", *UNIT, "-n", workers, "--dist=worksteal"]
    version = ".".join(map(str, sys.version_info[:2]))
    return Step(f"unit tests, Python {version}", [*command, *options], in_venv, minutes=1)


def plan_other_python(_form: str) -> list[Step]:
    """What may differ with the version of Python: whatever touches the system, and all imports.

    Also what needs programs of the lab.

    The system tests prove the rest there. Pure decisions are the same everywhere.
    """
    if sys.version_info[:2] == LAB_PYTHON:
        return []
    version = ".".join(map(str, LAB_PYTHON))
    folders = [f"tests/unit/{name}" for name in ("adapters", "gateway", "link", "runner", "trust")]
    arguments = [*folders, *WITH_TOOLS]
    return [lab_step(f"unit tests, Python {version}", "container", arguments, minutes=1)]


def plan_lab(_form: str) -> list[Step]:
    command = ["python", "-m", *PYTEST, "tests/lab"]
    return [Step("tests of the lab", command, in_venv, minutes=2)]


def plan_vm(_form: str) -> list[Step]:
    return [limits_step()]


def limits_step() -> Step:
    return lab_step("system tests that need limits, vm", "vm", marked("vm"), minutes=3)


def plan_emulator(_form: str) -> list[Step]:
    name = "system tests that need Debian's kernel, emulator"
    return [lab_step(name, "emulator", marked("emulator"), minutes=3)]


def build_step() -> Step:
    return Step("Debian packages", ["packaging/build"], os.environ.copy, minutes=2)


def reboot_step() -> Step:
    """One machine for all: the packages, a reboot and a power cut with them, and their end."""
    stages = (("before",), ("after", "cut"), ("was_cut", "purge"))
    command = ["tests/lab/lab", "run", "--"]
    for place, stage in enumerate(stages):
        command += ["--reboot--"] if place else []
        command += [*PYTEST, *(f"tests/boot/test_{name}.py" for name in stage)]
    return Step("the packages, a reboot and a power cut, vm", command, in_lab("vm"), minutes=3)


def plan_packages(_form: str) -> list[Step]:
    """The real .deb files, as a user installs them, and as a reboot finds them."""
    build = build_step()
    return [build, *(replace(one, after=(build.name,)) for one in (packages_step(), reboot_step()))]


def packages_step() -> Step:
    return lab_step("tests of the Debian packages", "container", ["tests/deb"], minutes=4)


def plan_platform(_form: str, suite: str) -> list[Step]:
    """Another release of Debian, where apt installs the packages, and uv wheels."""
    built = [build_step(), wheels_step()]
    more = (f"tests/deb/test_{name}.py" for name in ("deb", "first_block"))
    step = platform_step(suite, *more, minutes=4)
    return [*built, replace(step, after=tuple(one.name for one in built))]


def wheels_step() -> Step:
    return Step("wheels", ["packaging/wheels"], os.environ.copy, minutes=2)


def platform_step(suite: str, *options: str, minutes: int = 1) -> Step:
    """What users install there, and after a reboot what they have enabled."""
    place = "tests/platforms"
    # Not the folder: pytest drops a file that is named beside its folder. test_uv.py removes the
    # packages, which the transcripts need.
    names = {str(one.relative_to(CHECKOUT)) for one in (CHECKOUT / place).glob("test_*.py")}
    files = sorted(names, key=lambda one: (not one.endswith("test_uv.py"), one))
    before = [*files, *TYPED, *options, f"{place}/before_reboot.py"]
    step = lab_step(f"tests on Debian {suite}", suite, before, minutes)
    after = ["--reboot--", *PYTEST, f"{place}/after_reboot.py"]
    return replace(step, command=[*step.command, *after])


def plan_system(form: str) -> list[Step]:
    here = " and not lab" if form == "host" else ""
    arguments = ["tests/system", "-m", f"{IN_CONTAINER}{here}"]
    if form == "container":
        return queue_steps("system tests", "browser", arguments, minutes=14)
    if form != "host":
        return [lab_step(f"system tests, {form}", form, arguments)]
    if not Path("/run/systemd/system").is_dir():
        raise LabError("use LAB=host", "systemd is not running here; LAB=container brings its own")
    if os.geteuid() == 0:
        raise LabError("use LAB=host as root", "its tests run in user scope: be a user, not root")
    command = ["python", "-m", *PYTEST, *arguments]
    return [Step("system tests, this machine", command, partial(in_venv, for_system_tests=True))]


def plan_foreign(_form: str) -> list[Step]:
    """The packages and wheels for another processor, emulated: minutes, so by hand only."""
    build = Step("Debian packages", ["packaging/build", "--once"], os.environ.copy, minutes=2)
    wheels = Step("wheels", ["packaging/wheels", FOREIGN], os.environ.copy, minutes=5)
    tests = lab_step(f"tests on {FOREIGN}", FOREIGN, ["tests/platforms/foreign.py"], minutes=5)
    return [build, wheels, replace(tests, after=(build.name, wheels.name))]


def plan_browser(_form: str) -> list[Step]:
    return [lab_step("status page in a browser", "browser", marked("browser"), minutes=1)]


def plan_openarm(_form: str) -> list[Step]:
    return [openarm_step()]


def openarm_step() -> Step:
    return lab_step("nodes of OpenArm from PyPI", "openarm", marked("openarm"), minutes=2)


def plan_machines(_form: str) -> list[Step]:
    return machines_steps()


def machines_steps() -> list[Step]:
    """Three machines, twice."""
    return queue_steps("several machines", "machines", ["tests/machines"], 8, 2, "lab")


def plan_faults(form: str) -> list[Step]:
    """Every fault as often as ROUNDS says; a machine of its own, and nothing beside it."""
    rounds = os.environ.get("ROUNDS") or "1"
    marks = "vm" if form in MACHINES else IN_CONTAINER
    command = ["tests/lab/lab", "run", "--env", f"FAULT_ROUNDS={rounds}", "--", *installed(form)]
    command += ["pytest", FAULTS, "-m", marks]
    step = Step(f"faults, {form}", command, in_lab(form), minutes=3 * int(rounds))
    return [*packages_for(form), step]


def plan_transcripts(form: str) -> list[Step]:
    """What a person types; on another Debian, with the packages."""
    where = form if form in PLATFORMS else "container"
    command = ["tests/lab/lab", "run", "--", *installed(where), *PYTEST, TRANSCRIPTS]
    words = [*command, "-m", IN_CONTAINER]
    step = Step(f"transcripts, {where}", words, in_lab(where), minutes=2)
    return [*packages_for(where), step]


def plan_history(form: str) -> list[Step]:
    """Histories from SEED on, for HOURS or one; what breaks one is made shorter and printed.

    With LAB=vm there are faults of a whole machine among them: its clock, and its memory. With
    LAB=machines one dataflow has a node on a second machine, whose cable is pulled.
    """
    asked = ("--seed", "SEED", "1"), ("--steps", "STEPS", "40"), ("--hours", "HOURS", "0")
    chosen = [word for flag, name, usual in asked for word in (flag, os.environ.get(name) or usual)]
    kept = ["--out", "/out"] if os.environ.get("LAB_OUT") else []
    command = ["tests/lab/lab", "run", "--", "python", "-m", "tests.history", "--shrink"]
    where = form if form in ("vm", "machines") else "container"
    return [Step(f"histories, {where}", [*command, *chosen, *kept], in_lab(where))]


def plan_stops(form: str) -> list[Step]:
    """Stops of all kinds, STOPS of them; a machine restarts after every STAGE of them."""
    left, form = int(os.environ.get("STOPS") or "26"), form if form in MACHINES else "container"
    stage = STAGE if form in MACHINES else left
    command = ["tests/lab/lab", "run", "--"]
    for begun in range(0, left, stage):
        command += ["--reboot--"] if begun else []
        command += ["python", "-m", "tests.stops", str(min(stage, left - begun))]
    return [Step(f"stops, {form}", command, in_lab(form))]


def plan_kills(_form: str) -> list[Step]:
    """Processes of a dataflow with a recorder are killed, as often as ROUNDS says."""
    words = [os.environ.get("ROUNDS") or "40", os.environ.get("SEED") or "1"]
    command = ["tests/lab/lab", "run", "--", "python", "-m", "tests.system.recorder_kills", *words]
    return [Step("kills beside a recorder, container", command, in_lab("container"))]


def plan_power(_form: str) -> list[Step]:
    """The power fails in the middle of deploys and rollbacks, as often as ROUNDS says."""
    words = [os.environ.get("ROUNDS") or "10", os.environ.get("SEED") or "1"]
    command = ["tests/lab/lab", "run", "--cuts", "--", "python", "-m", "tests.power", *words]
    return [Step("power cuts, vm", command, in_lab("vm"), minutes=2 * int(words[0]))]


def plan_canary(_form: str) -> list[Step]:
    """What changes with another dora: the newest on PyPI, or VERSION."""
    version = [name for name in (os.environ.get("VERSION"),) if name]
    return [Step("canary", ["python", "-m", "tests.canary", *version], in_venv, minutes=6)]


def plan_fuzz(_form: str) -> list[Step]:
    seconds = os.environ.get("FUZZ_SECONDS") or "120"
    return [Step("fuzzing", ["python", "-m", "tests.fuzz", seconds], in_venv)]


def plan_mutants(_form: str) -> list[Step]:
    """Changes to the product, SAMPLE of them chosen by SEED, and how many unit tests notice."""
    need_root()  # for mounts and processes of its own
    asked = ("--seed", "SEED", "1"), ("--sample", "SAMPLE", "1000")
    chosen = [word for flag, name, usual in asked for word in (flag, os.environ.get(name) or usual)]
    return [Step("mutants", ["python", "-m", "tests.mutants", *chosen], in_venv_with_mutmut)]


def in_venv_with_mutmut() -> dict[str, str]:
    venv = ensure_venv(find_cache())
    add_package(venv, MUTMUT, NOT_WITH_MUTMUT)
    return venv_environment(venv)


def plan_quick(form: str) -> list[Step]:
    """The heart of the system tests; on another Debian, with the packages."""
    files = [f"tests/system/test_{name}.py" for name in QUICK]
    where = form if form in PLATFORMS else "container"
    steps = queue_steps("quick system tests", where, [*files, "-m", IN_CONTAINER])
    return [*packages_for(form), *steps]


def packages_for(form: str) -> list[Step]:
    """On another Debian the packages are tested, not the checkout."""
    command = ["packaging/build", "--once"]
    return [Step("Debian packages", command, os.environ.copy, minutes=2)][: form in PLATFORMS]


def installed(form: str) -> list[str]:
    """The words before a command that uses what is tested."""
    return ["tests/platforms/installed"] if form in PLATFORMS else []


def queue_steps(
    name: str,
    form: str,
    arguments: Sequence[str],
    minutes: int = 0,
    count: int = CONTAINERS,
    what: str = "container",
) -> list[Step]:
    """Labs at the same time, each of which runs the modules that no other one has taken."""
    given = os.environ.get("LAB_OUT")
    queue = Path(tempfile.mkdtemp(prefix="queue-", dir=given))
    atexit.register(shutil.rmtree, queue, ignore_errors=True)
    place = f"/out/{queue.name}" if given else "/out"
    env = {**os.environ, "LAB": form, "LAB_OUT": given or str(queue)}
    run = ["tests/lab/lab", "run", "--", *installed(form)]
    return [
        Step(
            f"{name}, {what} {number} of {count}",
            [*run, *PYTEST, f"--queue={place}", *arguments],
            env.copy,
            minutes=minutes,
            after=tuple(one.name for one in packages_for(form)),
        )
        for number in range(1, count + 1)
    ]


def lab_step(name: str, form: str, arguments: Sequence[str], minutes: int = 0) -> Step:
    command = ["tests/lab/lab", "run", "--", *PYTEST, *arguments]
    return Step(name, command, in_lab(form), minutes=minutes)


def marked(mark: str) -> list[str]:
    """The system tests of a mark, for pytest."""
    return [*(str(path.relative_to(CHECKOUT)) for path in marked_files(mark)), "-m", mark]


def plan_lint(_form: str) -> list[Step]:
    command = ["python", "-m", *PYTEST, "tests/unit/project/test_linters.py", "-k", "ruff or mypy"]
    return [Step("ruff and mypy", command, in_venv)]


PLANS: dict[str, Callable[[str], list[Step]]] = {
    "test": plan_test,
    "check": plan_check,
    "unit": plan_unit,
    "system": plan_system,
    "quick": plan_quick,
    "faults": plan_faults,
    "transcripts": plan_transcripts,
    "history": plan_history,
    "stops": plan_stops,
    "kills": plan_kills,
    "power": plan_power,
    "canary": plan_canary,
    "fuzz": plan_fuzz,
    "mutants": plan_mutants,
    "other-python": plan_other_python,
    "lab": plan_lab,
    "vm": plan_vm,
    "emulator": plan_emulator,
    "packages": plan_packages,
    **{suite: partial(plan_platform, suite=suite) for suite in PLATFORMS},
    FOREIGN: plan_foreign,
    "browser": plan_browser,
    "openarm": plan_openarm,
    "machines": plan_machines,
    "lint": plan_lint,
}

"""The Debian packages, and the workflow of a release, agree with the project."""

import re
import subprocess
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml

from dora_systemd import __version__
from dora_systemd.adapters.releases.store import store_root
from dora_systemd.decisions.unit.file import HEADER
from dora_systemd.decisions.unit.systemd_versions import MIN_VERSION
from dora_systemd.names import SLICE
from dora_systemd.verbs.start.where import DEFAULT_USER
from tests.lab.definition import OLD_SUITE
from tests.unit.checkout import CHECKOUT

PACKAGING = CHECKOUT / "packaging"
DEBIANS = (PACKAGING / "debian", PACKAGING / "dora-cli/debian")
TEMPLATES = CHECKOUT / "units/templates"
UNITS = sorted(
    path
    for path in TEMPLATES.iterdir()
    if path.suffix in (".slice", ".target", ".socket", ".service")
)
JOBS: dict[str, dict[str, Any]] = yaml.safe_load(
    (CHECKOUT / ".github/workflows/release.yml").read_text()
)["jobs"]
MATRIX = JOBS["wheels"]["strategy"]["matrix"]
"""The Pythons, and the machines, one for each processor."""
PROCESSORS = {"ubuntu-24.04": "x86_64", "ubuntu-24.04-arm": "aarch64"}
COMPILED = ("pystemd", "systemd-python")
"""PyPI has no wheels of these."""
RELEASED = ("dora-systemd_0.1.0_all.deb", "dora-cli_1_amd64.deb", "dora-cli_1_arm64.deb")


def version_of(debian: Path) -> str:
    found = re.match(r"\S+ \((.+)\) ", (debian / "changelog").read_text())
    assert found
    return found[1]


def test_versions() -> None:
    pyproject = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
    assert version_of(DEBIANS[0]) == pyproject["project"]["version"] == __version__


def test_changes_are_told_for_each_version() -> None:
    told = re.findall(r"^## (\S+)$", (CHECKOUT / "CHANGELOG.md").read_text(), re.MULTILINE)
    packaged = re.findall(r"^\S+ \((.+)\) ", (DEBIANS[0] / "changelog").read_text(), re.MULTILINE)
    assert told == packaged


def test_wheels_are_those_of_the_changelog() -> None:
    version = version_of(DEBIANS[1]).partition("-")[0]
    lines = (DEBIANS[1] / "SHA256SUMS").read_text().splitlines()
    for line in lines:
        assert re.fullmatch(rf"[0-9a-f]{{64}}  dora_rs_cli-{version}-\S+\.whl", line)
    assert [line.rpartition("_28_")[2] for line in lines] == ["x86_64.whl", "aarch64.whl"]
    assert f"-{version}-" in (DEBIANS[1] / "rules").read_text()


def test_dependencies() -> None:
    control = (DEBIANS[0] / "control").read_text()
    assert f"systemd (>= {MIN_VERSION})" in control
    assert "dora-cli (>= 1.0)" in control
    assert "${python3:Depends}" in control
    pyproject = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    assert f"X-Python3-Version: {pyproject['requires-python'].replace('>=', '>= ')}\n" in control
    for needed in pyproject["dependencies"]:
        # dh_python3 finds the packages, but leaves out which versions are enough.
        name, _, version = needed.replace("py", "", needed.startswith("pyyaml")).partition(">=")
        package = f"python3-{name.removesuffix('-python')}"
        assert f"\n {package} (>= {version}),\n" in control


def test_every_template_is_installed() -> None:
    rules = (DEBIANS[0] / "rules").read_text()
    for path in TEMPLATES.iterdir():
        assert f"$(TEMPLATES)/{path.name}" in rules, f"{path.name} is in no package"


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_units_are_fixed_text_with_a_manual(unit: Path) -> None:
    text = unit.read_text()
    if "@" in unit.name:  # systemd replaces %i and %t in a template, see systemd.unit(5)
        text = re.sub("%[it]|doranotice(-hold)?@", "", text)
    assert not re.search(r"[{}]|@(?!system-service)|%[a-zA-Z]", text)
    assert re.search(r"^Documentation=man:dora-systemd(-security)?\(7\)$", text, re.M)


def test_names_of_slice_and_user() -> None:
    assert (TEMPLATES / SLICE).is_file()
    assert f"\nu {DEFAULT_USER} " in (TEMPLATES / "dora-systemd.sysusers").read_text()


def test_no_unit_owns_the_releases() -> None:
    """systemctl clean removes what a unit owns; the gateway only writes there."""
    place = str(store_root().parent)
    texts = {path.name: path.read_text() for path in TEMPLATES.iterdir()}
    assert not [name for name, text in texts.items() if re.search("^StateDirectory=", text, re.M)]
    assert f"\nReadWritePaths=-{place}\n" in texts["dora-gateway-sandbox.conf"]
    assert f"\nd {place} 0755 root root -\n" in texts["dora-systemd.tmpfiles"]


def test_all_manuals_are_installed() -> None:
    listed = (DEBIANS[0] / "dora-systemd.manpages").read_text().split()
    there = [f"packaging/man/{path.name}" for path in (PACKAGING / "man").iterdir()]
    assert sorted(listed) == sorted(there)


def test_needrestart_leaves_dataflows_alone() -> None:
    """The file is evaluated by needrestart, which then takes the first pattern that matches."""
    file = CHECKOUT / "packaging/needrestart/50-dora-systemd.conf"
    script = (
        "our %nrconf; my $file = shift; my $text = do { local (@ARGV, $/) = $file; <> }; "
        "eval $text; die $@ if $@; "
        "for my $rc (@ARGV) { print grep({ $rc =~ /$_/ } keys %{$nrconf{override_rc}}) ? 1 : 0 }"
    )
    units = ("dora-robot.service", "doralink-robot:gpu.service", "dora-gateway.service")
    command = ("perl", "-we", script, str(file), *units, "ssh.service", "dora.slice")
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("11000", "")


@pytest.mark.parametrize("debian", DEBIANS, ids=str)
def test_overrides_say_why(debian: Path) -> None:
    for path in [*debian.glob("*lintian-overrides"), *debian.glob("source/lintian-overrides")]:
        is_explained = False
        for line in filter(None, path.read_text().splitlines()):
            assert line.startswith("#") or is_explained, f"{path}: {line}"
            is_explained = True


@pytest.mark.parametrize("debian", DEBIANS, ids=str)
def test_maintainer_scripts(debian: Path) -> None:
    for path in (path for kind in ("*.p*inst", "*.p*rm") for path in debian.glob(kind)):
        text = path.read_text()
        assert text.startswith("#!/bin/sh\nset -e\n")
        assert "#DEBHELPER#" in text
        assert not re.search(r"\b(start|enable|restart)\b", re.sub("#.*", "", text)), path
        subprocess.run(["sh", "-n", str(path)], check=True)


def test_upgrades_restart_nothing() -> None:
    """debhelper would: a restart of dora.slice is one of every dataflow."""
    rules = (DEBIANS[0] / "rules").read_text()
    assert re.search(
        r"^override_dh_installsystemd override_dh_installsystemduser:\n\n", rules, re.M
    )


def test_root_does_nothing_in_directories_of_users() -> None:
    """A user can put a link into the place of anything below /run/user/UID."""
    for script in (PACKAGING / "debian").glob("dora-systemd.p*"):
        for line in script.read_text().splitlines():
            is_meant = "/run/user" in line or '"$place' in line
            is_loop = line.lstrip().startswith(("#", "for place in "))
            assert not is_meant or is_loop or "as_owner " in line, f"{script.name}: {line}"


def test_purge_takes_what_enable_has_written(tmp_path: Path) -> None:
    """Also the links of enable --boot-check, and the units of links to other machines."""
    etc = tmp_path / "systemd/system"
    ours = [etc / "dora-robot.service", etc / "doralink-robot:gpu.service"]
    for place in ("dora.target.wants", "boot-complete.target.requires"):
        (etc / place).mkdir(parents=True)
        (etc / place / ours[0].name).symlink_to(ours[0])
    for path in ours:
        path.write_text(HEADER)
    others = [etc / "dora-foreign.service", etc / "boot-complete.target.requires/x.service"]
    for path in others:
        path.touch()
    script = (PACKAGING / "debian/dora-systemd.postrm").read_text()
    part = script[script.index("    for unit in /etc/") : script.index("    # Only the one that")]
    subprocess.run(["sh", "-euc", part.replace("/etc/", f"{tmp_path}/")], check=True)
    left = [path for path in tmp_path.rglob("*") if not path.is_dir() or path.is_symlink()]
    assert sorted(left) == sorted(others)
    assert not (etc / "dora.target.wants").exists()


def step_of(job: str, words: str) -> dict[str, Any]:
    """The step that runs a command that begins with these words, or uses this action."""
    (step,) = [
        one for one in JOBS[job]["steps"] if (one.get("run") or one["uses"]).startswith(words)
    ]
    return dict(step)


def test_wheels_for_each_python_and_processor() -> None:
    assert MATRIX["python"] == ["3.11", "3.12", "3.13", "3.14"]
    assert MATRIX["runner"] == [*PROCESSORS]
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == f">={MATRIX['python'][0]}"
    assert JOBS["wheels"]["runs-on"] == "${{ matrix.runner }}"
    image = f"python:${{{{ matrix.python }}}}-{OLD_SUITE}"
    assert JOBS["wheels"]["container"] == image, "libsystemd and glibc of the oldest system"
    assert {".", *COMPILED} <= {*step_of("wheels", "pip wheel")["run"].split()}


def test_the_packages_are_those_of_make_deb() -> None:
    assert step_of("packages", "make")["run"] == "make deb"
    assert re.search(r"^deb:", (CHECKOUT / "Makefile").read_text(), re.MULTILINE)


def built_wheels(place: Path, python: str, runner: str) -> list[Path]:
    """What the job for one Python uploads, of wheels that are empty files."""
    number = python.replace(".", "")
    compiled = f"cp{number}-cp{number}-linux_{PROCESSORS[runner]}.whl"
    (wheels := place / "wheels").mkdir(parents=True)
    (wheels / "dora_systemd-0.1.0-py3-none-any.whl").touch()
    for name in COMPILED:
        (wheels / f"{name.replace('-', '_')}-1-{compiled}").touch()
    remove = step_of("wheels", "rm ")
    assert remove["if"] == "matrix.python != '3.11' || matrix.runner != 'ubuntu-24.04'"
    if (python, runner) != ("3.11", "ubuntu-24.04"):
        subprocess.run(["sh", "-euc", remove["run"]], cwd=place, check=True)
    return list(place.glob(step_of("wheels", "actions/upload")["with"]["path"]))


def test_a_release_has_each_file_once_and_its_checksum(tmp_path: Path) -> None:
    (dist := tmp_path / "dist").mkdir()
    for python, runner in product(MATRIX["python"], MATRIX["runner"]):
        for wheel in built_wheels(tmp_path / python / runner, python, runner):
            assert not (dist / wheel.name).exists(), "one of another job"
            wheel.rename(dist / wheel.name)
    for name in RELEASED:
        (dist / name).touch()
    assert len([*dist.glob("*.whl")]) == 1 + len(COMPILED) * 4 * 2
    sums = step_of("release", "cd dist")["run"]
    subprocess.run(["sh", "-euc", sums], cwd=tmp_path, check=True)
    check = ["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"]
    subprocess.run(check, cwd=dist, check=True)
    lines = (dist / "SHA256SUMS").read_text().splitlines()
    assert {line.split()[1] for line in lines} == {path.name for path in dist.glob("*[bl]")}


def test_only_a_tag_makes_a_release_and_only_of_all_jobs() -> None:
    release = JOBS["release"]
    assert release["if"] == "github.ref_type == 'tag'"
    assert set(release["needs"]) == {*JOBS} - {"release"}
    assert release["permissions"] == {"contents": "write"}
    download = step_of("release", "actions/download")["with"]
    assert download == {"path": "dist", "merge-multiple": True}
    names = [step_of(job, "actions/upload")["with"]["name"] for job in release["needs"]]
    assert names == ["wheels-${{ matrix.python }}-${{ matrix.runner }}", "packages"]
    assert step_of("release", "gh release create")["run"].endswith(" dist/*")

"""The package of the dora command for the processor that this machine does not have."""

import subprocess
from pathlib import Path

import pytest

from tests.deb import packages
from tests.system.cells import run

MACHINES = {"amd64": 62, "arm64": 183}
"""e_machine of an ELF file, see elf(5)."""
LIBRARY = "./usr/lib/dora-cli/dora_cli.abi3.so"


def find_package(processor: str) -> str:
    (path,) = (packages.CHECKOUT / "dist").glob(f"dora-cli_*_{processor}.deb")
    return str(path)


def read_names(package: str) -> list[str]:
    """Modes, owners and names of the files; sizes differ."""
    lines = run("dpkg-deb", "--contents", package).stdout.splitlines()
    return [" ".join((*line.split()[:2], line.split()[5])) for line in lines]


@pytest.mark.skipif(packages.AUTOPKGTEST, reason="the repository has those of this machine")
def test_both_packages_of_dora_have_the_same_files() -> None:
    names = {processor: read_names(find_package(processor)) for processor in MACHINES}
    assert names["arm64"] == names["amd64"]
    assert any(LIBRARY in name for name in names["arm64"])


@pytest.mark.skipif(packages.AUTOPKGTEST, reason="the repository has those of this machine")
@pytest.mark.parametrize("processor", MACHINES)
def test_the_library_is_one_of_that_processor(processor: str, tmp_path: Path) -> None:
    package = find_package(processor)
    assert run("dpkg-deb", "--field", package, "Architecture").stdout.strip() == processor
    archive = tmp_path / "package.tar"
    with archive.open("wb") as file:
        subprocess.run(["dpkg-deb", "--fsys-tarfile", package], stdout=file, check=True)
    run("tar", "--extract", f"--file={archive}", f"--directory={tmp_path}", LIBRARY)
    with (tmp_path / LIBRARY).open("rb") as file:
        header = file.read(20)
    assert header[:5] == b"\x7fELF\x02"
    assert int.from_bytes(header[18:20], "little") == MACHINES[processor]

"""What this machine offers for real time, read from pretended files."""

import gzip
from pathlib import Path

import pytest

from dora_systemd.adapters.host import real_time
from dora_systemd.adapters.host.process import Completed
from dora_systemd.adapters.host.real_time import read_real_time
from dora_systemd.decisions.views.real_time import RealTime

CONFIG = "CONFIG_CGROUPS=y\nCONFIG_RT_GROUP_SCHED=y\n# CONFIG_RT_GROUP_SCHED_DEFAULT_DISABLED\n"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(real_time, "_CPUS", tmp_path / "cpu")
    configs = (str(tmp_path / "config.gz"), str(tmp_path / "config"))
    monkeypatch.setattr(real_time, "_CONFIGS", configs)
    monkeypatch.setattr(real_time, "run_command", lambda *_: Completed(1, "", "no"))
    monkeypatch.setattr("os.geteuid", lambda: 0)
    return tmp_path


def test_a_machine_that_says_nothing(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_real_time() == RealTime(None, False, False)
    (machine / "config.gz").write_bytes(b"no gzip")
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert read_real_time() == RealTime()


@pytest.mark.parametrize("name", ["config.gz", "config"])
@pytest.mark.parametrize("is_on", [True, False])
def test_its_kernel(machine: Path, name: str, is_on: bool) -> None:
    text = (CONFIG if is_on else CONFIG.replace("=y", "=n")).encode()
    (machine / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    assert read_real_time().has_groups is is_on


def test_its_cpus(machine: Path) -> None:
    for number, governor in enumerate(("powersave", "performance", "powersave")):
        place = machine / f"cpu/cpu{number}/cpufreq"
        place.mkdir(parents=True)
        (place / "scaling_governor").write_text(f"{governor}\n")
    (machine / "cpu/isolated").write_text("2-3\n")
    found = read_real_time()
    assert (found.isolated, found.governors) == ("2-3", ("performance", "powersave"))

"""Core dumps and reboots that somebody else has set up."""

import pytest

from dora_systemd.decisions.views.findings import State
from dora_systemd.decisions.views.upkeep import judge_core_pattern, judge_reboots, judge_stops

SYSTEMD = "|/usr/lib/systemd/systemd-coredump %P %u %g %s %t 9223372036854775808 %h %d\n"
PATTERNS = {
    SYSTEMD: "coredumpctl",
    "|/usr/share/apport/apport -p%p -s%s -c%c -d%d -P%P -u%u -g%g -F%F -- %E\n": "apport takes",
    "@@/run/systemd/coredumpd/kernel\n": "coredumpctl",
    "core\n": "kernel.core_pattern is core",
    "": "kernel.core_pattern is empty",
    "|/opt/systemd-coredump-like %P": "kernel.core_pattern is |/opt/",
}


@pytest.mark.parametrize(("pattern", "expected"), PATTERNS.items())
def test_core_patterns(pattern: str, expected: str) -> None:
    finding = judge_core_pattern(pattern)
    assert expected in finding.text
    is_fine = expected == "coredumpctl"
    assert (finding.state is State.OK, bool(finding.remedy)) == (is_fine, not is_fine)


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ("[Coredump]\n#ProcessSizeMax=0\n", "why and coredumpctl show"),
        ("[Coredump]\nProcessSizeMax=2G\n", "why and coredumpctl show"),
        ("[Coredump]\nProcessSizeMax=0\nProcessSizeMax = 1G\n", "why and coredumpctl show"),
        ("[Coredump]\nStorage=none\nProcessSizeMax = 0\n", "ProcessSizeMax= in coredump.conf"),
    ],
)
def test_what_systemd_coredump_may_process(config: str, expected: str) -> None:
    assert expected in judge_core_pattern(SYSTEMD, config=config).text


def test_core_dumps_of_other_systems() -> None:
    assert "not installed" in judge_core_pattern(SYSTEMD, is_there=False).text
    inside = judge_core_pattern(SYSTEMD, is_container=True)
    assert (inside.state, "to its host" in inside.text) == (State.NOTE, True)


ON = 'APT::Periodic::Unattended-Upgrade "1";\n'
REBOOT = 'Unattended-Upgrade::Automatic-Reboot "true";\n'
TIME = 'Unattended-Upgrade::Automatic-Reboot-Time "02:00";\n'
CONFIGS = {
    "": "",
    ON: "",
    REBOOT: "",  # they do not run by themselves
    ON + REBOOT: "as soon as they are done",
    ON + REBOOT + TIME: "at 02:00",
    TIME + REBOOT + ON: "at 02:00",
    ON + "//" + REBOOT: "",
    ON + "# " + REBOOT: "",
    ON + "/* " + REBOOT + " */": "",
    ON + REBOOT + REBOOT.replace("true", "false"): "",
    ON + REBOOT + ON.replace("1", "0"): "",
    ON + 'Unattended-Upgrade {\n  Automatic-Reboot "true";\n  Automatic-Reboot-Time "03:30";\n};': (
        "at 03:30"
    ),
    ON + 'X "http://a//b"; ' + REBOOT: "as soon as",
}


@pytest.mark.parametrize(("config", "expected"), CONFIGS.items())
def test_upgrades_that_reboot(config: str, expected: str) -> None:
    findings = list(judge_reboots(config))
    assert bool(findings) == bool(expected)
    for one in findings:
        assert one.state is State.WARNING
        assert expected in one.text


def test_stops_longer_than_a_shutdown_waits_for_a_user() -> None:
    minute = 60_000_000
    (finding,) = judge_stops({"robot": 5 * minute, "vision": 2 * minute}, 2 * minute)
    assert finding.text == (
        "the stop of robot may take 5min, and a shutdown waits 2min for all services of a user"
    )
    assert finding.remedy.endswith("[Service] TimeoutStopSec=5min")
    assert not list(judge_stops({"robot": 5 * minute}, 0))

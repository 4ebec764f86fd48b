"""What is believed of what another machine says of itself."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.machines.description import Facts, parse_facts, problems, summary
from dora_systemd.errors import DoraSystemdError

FACTS = Facts("0.1.0", "1.1.0", "/usr/bin/doractl", "alice", True, 1_767_225_690_250_000)


def test_what_is_said_is_read() -> None:
    assert parse_facts(f"a last word of a login shell\n{FACTS.to_json()}\n") == FACTS


@pytest.mark.parametrize("now", ["1e999", "-1e999", "NaN", "9" * 401, "9" * 5000, "-1", "1.5"])
def test_a_clock_that_is_none(now: str) -> None:
    text = FACTS.to_json().replace(str(FACTS.now), now)
    with pytest.raises(DoraSystemdError, match="cannot read what the machine says"):
        parse_facts(text)


@pytest.mark.parametrize("now", [0, 2**63 - 1])
def test_any_other_clock_can_be_compared(now: int) -> None:
    facts = parse_facts(replace(FACTS, now=now).to_json())
    (found,) = problems(FACTS, facts, facts.now - FACTS.now)
    assert "its clock differs" in found[0]
    assert summary(facts, now)["clock"].endswith(" ms")

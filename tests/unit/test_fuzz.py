"""A short round of tests/fuzz: what was kept, and a few new inputs for each target."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.corpus import CORPUS, kept
from tests.fuzz.inputs import inputs
from tests.fuzz.targets import TARGETS

EXAMPLES = 15


@pytest.mark.parametrize("name", TARGETS)
def test_kept_inputs_break_nothing(name: str) -> None:
    assert kept(name), f"no example in {CORPUS / name}"
    for data in kept(name):
        TARGETS[name].feed(data)


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_new_inputs_break_nothing(name: str, data: st.DataObject) -> None:
    TARGETS[name].feed(data.draw(inputs(kept(name))))


def test_every_kept_input_has_a_target() -> None:
    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)

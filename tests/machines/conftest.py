"""After a test without flow_on(): no unexpected warning in the journal of any machine."""

from collections.abc import Iterator

import pytest

from tests.machines import journals


@pytest.fixture
def quiet_journals(request: pytest.FixtureRequest) -> Iterator[None]:
    """Comes before the dataflow, and looks when that has ended."""
    with journals.quiet_journals(journals.announced(request)):
        yield

"""A command of on_failure that cannot run is refused before anything starts."""

from typing import Any

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.on_failure import check_units, find_command
from tests.unit.fakes.manager import FakeManager, options
from tests.unit.verbs.start.test_programs import Disk, elf

DISK = Disk(files={"/usr/bin/tell": elf(62), "/srv/tell": elf(62)})
SCOPE = Scope(is_user=False, uid=0)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ((), ()),
        (("tell", "x"), ("/usr/bin/tell", "x")),
        (("/srv/tell",), ("/srv/tell",)),
        (("unit:x.service",), ("unit:x.service",)),
    ],
)
def test_the_program_is_found(words: tuple[str, ...], found: tuple[str, ...]) -> None:
    assert find_command(words, DISK, None, "bin:/bin:/usr/bin") == found


@pytest.mark.parametrize("words", [("nothing",), ("/srv/nothing",)])
def test_a_program_that_cannot_run(words: tuple[str, ...]) -> None:
    with pytest.raises(DoraSystemdError) as refused:
        find_command(words, Disk(files={"/usr/bin/x": b""}), None, "/usr/bin")
    assert words[0] in refused.value.message
    assert refused.value.hint


def loaded(*units: str) -> FakeManager:
    manager = FakeManager()
    manager.units |= {unit: {"LoadState": "loaded"} for unit in units}
    return manager


OURS = "doranotice@robot.service"
TEMPLATE = ("unit:x@.service",)


@pytest.mark.parametrize(
    ("manager", "words", "missing"),
    [
        (loaded(), (), ""),
        (loaded(OURS), ("/bin/tell",), ""),
        (loaded(), ("/bin/tell",), OURS),
        (loaded(OURS), TEMPLATE, "x@robot.service"),
        (loaded(OURS, "x@robot.service"), TEMPLATE, ""),
    ],
)
def test_units_that_systemd_has_to_know(manager: Any, words: Any, missing: str) -> None:
    message = ""
    try:
        check_units(manager, SCOPE, options().with_value("on_failure", words))
    except DoraSystemdError as error:
        assert error.code is ExitCode.BAD_INPUT
        message = error.message
    assert message == (f"cannot use on_failure: unit {missing} is not-found" if missing else "")

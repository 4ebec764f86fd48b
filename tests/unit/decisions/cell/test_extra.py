"""The ids of added nodes."""

import pytest

from dora_systemd.decisions.cell.extra import EXTRA, extra_id, is_extra


@pytest.mark.parametrize("name", EXTRA)
def test_ids(name: str) -> None:
    """The daemon serves such a node after those of nearly every dataflow."""
    assert sorted([extra_id(name, 1), "camera", "sink", "zoom", "z"])[-1] == extra_id(name, 1)
    assert is_extra(extra_id(name, 12), name)
    assert is_extra(name, name), "it would have the same cgroup"
    assert not is_extra("zzz-camera", name)

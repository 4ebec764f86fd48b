"""What another account is asked about paths, and what a hostile one can do with that."""

import subprocess

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.programs import own_account
from dora_systemd.trust.sight import LentSight

LONG = "/" + "x" * 4000
"""A pipe is full after some of these."""


def test_answers_to_questions_that_nobody_reads() -> None:
    """The account can trace the child and have it say yes to all, without a look."""
    command = ["sh", "-c", "exec yes +00000011 | tr -d '\\n'"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as child:
        sight = LentSight(child, own_account(), 2.0)
        assert sight.exists("/nowhere")
        with pytest.raises(DoraSystemdError, match="no answer"):
            for _ in range(64):
                sight.exists(LONG)
        child.kill()

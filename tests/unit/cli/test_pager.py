"""The pager of `doractl logs`: what is root's by sudo does not become a root shell."""

import pytest

from dora_systemd.cli.verbs.look.logs import pager_of

MORE = {"PAGER": "more", "HOME": "/root"}


@pytest.mark.parametrize(
    ("environ", "pager", "is_secure"),
    [
        ({}, "less", False),
        (MORE, "more", False),
        ({**MORE, "SYSTEMD_PAGER": " "}, "more", False),
        ({"SUDO_UID": "1000"}, "less", True),
        ({"SUDO_UID": "1000", **MORE}, "less", True),
        ({"PKEXEC_UID": "1000", **MORE}, "less", True),
        ({"SUDO_UID": "1000", "SYSTEMD_PAGERSECURE": "0", **MORE}, "more", False),
        ({"SYSTEMD_PAGERSECURE": "1", **MORE}, "more", True),
        ({"SYSTEMD_PAGERSECURE": "1"}, "less", True),
    ],
)
def test_pager(environ: dict[str, str], pager: str, is_secure: bool) -> None:
    command, environment = pager_of(environ)
    assert (command, "LESSSECURE" in environment) == (pager, is_secure)
    assert environment.items() >= environ.items()

"""The pager of `doractl logs`: what is root's by sudo does not become a root shell."""

from pathlib import Path

import pytest

from dora_systemd.cli.verbs.look.logs import pager_of, print_paged

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


def test_an_interrupt_is_for_the_pager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Less without K goes on after Ctrl+C, and reads the rest."""
    read = tmp_path / "read"
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("DORACTL_PAGER", f"kill -INT $PPID; cat >{read}")
    print_paged(iter([b"one\n", b"two\n"]))
    assert read.read_text() == "one\ntwo\n"

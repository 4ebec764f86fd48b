import io

from dora_systemd.cli.stageline import StageLine


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_stage_is_written_once_and_erased_at_the_end() -> None:
    stream = Terminal()
    with StageLine(stream) as stage:
        stage("starting")
        stage("starting")
        stage("started")
    assert stream.getvalue() == "\r\x1b[Kstarting\r\x1b[Kstarted\r\x1b[K"


def test_room_for_other_output() -> None:
    stream = Terminal()
    with StageLine(stream) as stage:
        stage("starting")
        stage.wipe()
        stream.write("warning\n")
        stage("starting")
    assert stream.getvalue() == "\r\x1b[Kstarting\r\x1b[Kwarning\n\r\x1b[Kstarting\r\x1b[K"


def test_nothing_to_a_pipe() -> None:
    stream = io.StringIO()
    with StageLine(stream) as stage:
        stage("starting")
    assert not stream.getvalue()

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


def test_a_pipe_hears_once_which_machine_is_away() -> None:
    stream = io.StringIO()
    away = "waiting for machines gpu (it is not connected yet), pi (connection refused)"
    with StageLine(stream) as stage:
        stage("waiting for machine gpu (it is not connected yet)")
        stage(away)
        stage(away)
    assert stream.getvalue() == f"{away}\n"

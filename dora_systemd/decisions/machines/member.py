"""What `doractl start` tells one member of a dataflow. Pure."""

from typing import NamedTuple

from dora_systemd.decisions.remote.hosts import Host


class Member(NamedTuple):
    """A machine that runs nodes of a dataflow whose head is here.

    machine: its name. host: for ssh(1). words: the arguments of doractl there, which begin with
    `member FILE`; nobody but doractl writes them, see dora_systemd.decisions.machines.wire.
    """

    machine: str
    host: Host
    words: tuple[str, ...]

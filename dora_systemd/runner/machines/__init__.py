"""Head and members of a dataflow with several machines.

The head's runner has a member as a session of its socket, a member's runner has the head as its
standard input (`lines.py`). `roster.py` is what the head knows of its members. Before each run the
head connects to each daemon once.

All machines start at the same time. The head chooses its ports before it imports anything large,
and `adapters/runner_socket/door.py` sends them to the links meanwhile, so ssh logs in while the
coordinator boots. `doractl member` passes its connection and the part to the runner of the member
as standard input, and `boot.py` starts the daemon before that runner imports the rest. The
connection itself goes through that socket (SCM_RIGHTS): systemd keeps a copy of whatever is
standard input, and would hide the end of a runner from the head.
"""

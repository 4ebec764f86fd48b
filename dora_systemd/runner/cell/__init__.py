"""From the first child to the last: boot, pump, dialogue, restarts, clock.

The runner starts a coordinator and dora's own checks (`adapters/dora/check.py`). A thread starts
the daemon when the coordinator listens (`boot.py`). Meanwhile the runner imports its own code and
reads the descriptor, and sends it with every program replaced by `launcher.pl`. If the runner
refuses the dataflow, STATUS= has the reason, and the exit status depends on the kind of reason
(`decisions/life/refusal.py`).

Before a restart systemd waits for the shortest delay without its last 400 ms, and `restarts.py` for
the rest, in which all gets ready that comes before the nodes. The runner refuses the restart
that would exceed the budget (exit status 75): systemd's StartLimitBurst= counts starts by hand as
well, so it is larger, for lives that end before the runner.
"""

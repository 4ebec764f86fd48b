"""The post-mortem: records become lives, lives a verdict, or the fault that fails a trial.

`lives.py` groups the records of the journal into lives, one for each invocation of the unit.
`postmortem.py` finds a verdict (`verdict.py`) about them, and `report.py` formats it.
`last_lines.py` chooses the last lines, for a start that failed as well. `trial_faults.py` has the
faults for which a release fails its trial. So events must contain what a verdict needs:
`dataflow-failed` has its cause in one word (`life/causes.py`), a crash has the nodes downstream,
and `doractl stop` records its caller, because systemd does not.
"""

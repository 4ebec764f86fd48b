"""Numbers of a cgroup and what they mean: usage, out of memory, pressure.

`oom.py` finds whose memory was used up, from counters before and after an OOM kill. `pressure.py`
decides when to report pressure before a kill, and how often.
"""

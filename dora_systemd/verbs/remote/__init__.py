"""-H: which hosts, and the connections with them.

`talk.py` runs ssh(1) to all hosts at the same time, with a bound for each step.
"""

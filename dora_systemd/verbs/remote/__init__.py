"""-H: the hosts, and the connections to them.

`talk.py` runs ssh(1) to all hosts in parallel, with a timeout for each step.
"""

"""-H: names of hosts, the command for ssh(1), answers with their host.

`hosts.py` has the scripts for ssh. A mark before the first byte of doractl separates that byte from
what a login shell prints. What follows (`run`, `logs -f`) ends when its standard input does.
"""

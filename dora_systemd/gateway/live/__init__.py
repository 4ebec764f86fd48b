"""What the status page receives and what it can do.

`doractl top`, `/metrics` and the page use the same snapshot of all dataflows (`verbs/top.py`). It
has counters; percentages of time need two snapshots. `page.py` sends the page (`static/`, plain
files, no build step) one every two seconds, and the page keeps the last minutes itself. All its
other requests are messages. `actions.py` rolls back in a thread, which it can end.
"""

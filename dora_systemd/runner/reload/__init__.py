"""Files that change while the dataflow runs.

`sources.py` reads them, `swap.py` replaces one node in dora, `apply.py` carries out and undoes the
steps, `reloader.py` coordinates both with the runs of the dataflow. If dora cannot make a change in
place, the run ends and the next one begins in the same process. `doractl reload`, `systemctl
reload` and `doractl set --hot-reload` send requests.
"""

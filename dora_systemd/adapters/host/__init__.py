"""This machine: files, processes, devices, rights, sd_notify(3), changed files.

`fd_store.py` has systemd count the lives since the last quiet window or stop, with their times.
`watch.py` reports changed files in batches.
"""

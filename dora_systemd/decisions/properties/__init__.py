"""KEY=VALUE of --property: types of D-Bus, text of unit files, the sandbox.

systemd mounts as root: `sandbox.py` explains why it only gets the `paths.firm_part()` of a path.
"""

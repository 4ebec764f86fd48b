"""The tree below /sys/fs/cgroup: groups of nodes, limits, usage."""

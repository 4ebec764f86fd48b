"""The same dataflows under `dora run` and `doractl run`."""

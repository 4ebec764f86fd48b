"""The unit of a dataflow, as properties for systemd and as a file."""

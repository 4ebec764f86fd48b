"""Dora's YAML: the dataflow, its nodes, their wiring, the session of a build."""

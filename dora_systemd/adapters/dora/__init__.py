"""The dora command, coordinator and daemon, and dora's checks of a dataflow."""

"""The processes between the runners of head and member. Each runs as long as the dataflow."""

"""The order in which a node is replaced. A start knows these words, and nothing else of reloads."""

START_FIRST = "start-first"
REPLACE_WORDS = ("stop-first", START_FIRST)
"""What is first when a node gets another process: the end of the old one, or the start."""

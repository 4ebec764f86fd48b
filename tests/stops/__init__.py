"""Stops of all kinds, and what a recorder has lost: python -m tests.stops COUNT."""

"""Dora's frames, error texts, coordinator and command."""

"""Tests that need several machines: LAB=machines."""

"""Notices of failures."""

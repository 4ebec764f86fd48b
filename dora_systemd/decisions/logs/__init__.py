"""Bytes become lines, lines become fields of the journal; queries and formats of logs."""

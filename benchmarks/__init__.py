"""What supervision costs, beside what users would take instead: see README.md here."""

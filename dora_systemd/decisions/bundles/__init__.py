"""What a bundle may have."""

"""What nodes report with sd_notify(3), and when a node has missed its watchdog."""

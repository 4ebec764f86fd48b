"""What nodes wait for: the words of `needs`, steps, dependencies of the unit, devices."""

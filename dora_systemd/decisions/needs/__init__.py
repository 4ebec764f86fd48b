"""What nodes wait for: steps, dependencies of the unit, devices of the sandbox."""

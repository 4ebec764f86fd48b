"""The test lab: a booted Debian with dora and the checkout, as a container or as a machine."""

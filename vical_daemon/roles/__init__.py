"""Roles: one job of the daemon each; `run(config, bus, stop)` around a class without I/O."""

"""From nothing to a running filter: a closed form, one window about it, and the filter about the window."""

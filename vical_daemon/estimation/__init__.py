"""Estimation: arithmetic only (numpy, scipy); nothing here reads a clock, a file or a socket."""

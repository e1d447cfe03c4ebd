"""Noise levels, measured from the data."""

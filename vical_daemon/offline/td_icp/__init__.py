"""Temporal calibration of recordings: where orientations come from, one camera, or any number of sensors."""

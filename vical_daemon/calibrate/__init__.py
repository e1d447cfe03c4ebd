"""The role that estimates the calibration."""

"""The parts of target-free calibration: start, windows of bundle adjustment, what is carried on and told."""

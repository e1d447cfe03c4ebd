"""The parts of target-free calibration: start, windows of bundle adjustment, handover and report."""

"""vical: online camera-IMU calibration daemon (bus, roles, recorder, estimator, command line)."""

"""Offline tools: Allan deviation, IMU calibration at rest, observability."""

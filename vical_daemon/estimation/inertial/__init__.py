"""Inertial readings: intake, buffer, integration."""

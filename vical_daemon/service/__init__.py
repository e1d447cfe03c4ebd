"""Shared by all processes of the service: clock, health, systemd, atomic files."""

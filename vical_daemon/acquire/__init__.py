"""The roles that read devices."""

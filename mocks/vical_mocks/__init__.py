"""Byte-exact and physics-true stand-ins for devices, for tests and for the demo."""

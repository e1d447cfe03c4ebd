"""The parts of TD-ICP: curves of orientation, their registration in time and space, and the watch."""

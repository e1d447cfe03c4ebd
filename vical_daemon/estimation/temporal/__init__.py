"""Delay and mounting from rotations: TD-ICP on curves of orientation, the epipolar constraint, the watch."""

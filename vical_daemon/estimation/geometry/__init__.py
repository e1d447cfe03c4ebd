"""Rotations, poses, and motion at one instant."""

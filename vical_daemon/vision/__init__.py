"""Targets, detectors and feature tracks: the only folder that imports cv2."""

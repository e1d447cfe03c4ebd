"""How far to trust a calibration: measured noise, hypotheses about the rig, changes, status in words."""

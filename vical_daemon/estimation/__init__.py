"""Estimation: arithmetic only (numpy, scipy); nothing here reads a clock, a file or a socket.

The roles use `calibrator` (with a target), `target_free`, `target_free_rig` and `temporal.td_icp`. Input and
output are in `measurements`, `result`, `events`, `guidance` and `wording`. The packages, from the bottom:
`geometry` (rotations, cameras, planar poses), `inertial` (readings and their integration), `model` (state and
measurement model), `temporal` (TD-ICP), `noise` (noise levels measured from data), `filter` (the unscented
filter), `selection` (which model of the rig the data support), `init` (from nothing to a running filter),
`status` (how far to trust a calibration), `smoother` (windows of bundle adjustment, for calibration without a
target), and `tools` (Allan deviation, IMU calibration at rest, observability).
"""

"""Estimation: arithmetic only (numpy, scipy); nothing here reads a clock, a file or a socket.

`calibrator` (with a target), `target_free` and `td_icp` are what the roles use. Beside what these share
(rotations, cameras, inertial data, the filter) there are four folders: `start`, from nothing to a running
filter; `trust`, how far to believe it; `free`, the parts of calibration without a target; `temporal`, those
of TD-ICP.
"""

"""Results of a calibration: store, exports, report."""

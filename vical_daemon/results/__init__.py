"""What a calibration leaves behind: store, exports, report."""

"""How far to trust a calibration: status, reasons, changes."""

"""FireWire (IIDC) cameras: libdc1394 by ctypes, dated by the bus clock."""

"""Cameras: V4L2 and IIDC (FireWire) frame sources whose stamps mean mid-exposure."""

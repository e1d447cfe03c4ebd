"""GenICam cameras (GigE Vision, USB3 Vision): Aravis, in a process of the distribution's Python."""

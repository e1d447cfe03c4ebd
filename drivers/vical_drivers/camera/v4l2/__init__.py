"""V4L2 cameras, USB cameras among them: our own layer over the kernel's requests."""

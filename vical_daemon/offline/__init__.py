"""Use cases on files: each command that reads a recording, callable from Python, without printing."""

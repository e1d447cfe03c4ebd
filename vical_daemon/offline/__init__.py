"""Use cases on files, each callable from Python."""

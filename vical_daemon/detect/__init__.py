"""The role that finds points in images."""

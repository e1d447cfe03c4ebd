"""The one settings file of a rig, and where the service keeps its files."""

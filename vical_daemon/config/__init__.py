"""The settings file of a rig, and the folders of the service."""

"""Which model of the rig the data support."""

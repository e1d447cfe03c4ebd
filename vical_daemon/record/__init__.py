"""The role that records MCAP logs."""

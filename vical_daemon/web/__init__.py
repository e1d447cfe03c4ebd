"""The page with the live calibration: its state, HTTP server, and static files (no build step)."""

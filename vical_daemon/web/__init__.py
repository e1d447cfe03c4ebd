"""The page with the live calibration: state kept from the bus, HTTP server, static files (no build step)."""

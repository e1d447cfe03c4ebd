"""Device drivers without any daemon in them: bytes and frames in, stamped samples out."""

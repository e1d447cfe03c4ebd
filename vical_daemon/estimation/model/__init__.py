"""The measurement model: state, cameras, targets, what goes in and what comes out."""

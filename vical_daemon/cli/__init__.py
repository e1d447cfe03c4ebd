"""The `vical` command: one module per subcommand; importing this package imports nothing heavy."""


def main() -> int:
    """Run the command line (the console script `vical`)."""
    raise SystemExit(2)

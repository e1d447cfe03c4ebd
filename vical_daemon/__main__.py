"""`python -m vical_daemon` is `vical`."""

from vical_daemon.cli import main

if __name__ == "__main__":
    raise SystemExit(main())

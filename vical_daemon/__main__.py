"""`python -m vical_daemon` and the console script `vical`; the first module of vical that is loaded."""

import signal
import sys


def main() -> int:
    """Run the command line; ^C while modules load, or at the very end, ends the process without a traceback.

    The parent sees SIGINT as the cause, which a shell reports as 130. A ^C that is ignored (a job that a
    script started with `&`) stays so.
    """
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if interruptible:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from vical_daemon.cli import main as command_line

    try:
        if interruptible:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return command_line()
    except KeyboardInterrupt:  # before or after what the command line itself handles
        return 130
    finally:
        if interruptible:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    sys.exit(main())

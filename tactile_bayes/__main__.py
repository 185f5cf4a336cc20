"""Start of the program, also as ``python -m tactile_bayes``."""

import signal


def main() -> None:
    """Run the program; Ctrl-C while it is loaded ends it without a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, as in the background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from tactile_bayes import cli  # slow to import: Ctrl-C is likely meanwhile

    cli.main()


if __name__ == "__main__":
    main()

"""Where the process of a command begins and ends: Ctrl-C is heeded before anything slow is imported."""

from __future__ import annotations

import signal
import sys

from endotwin.cli.stop import Stopped, heed_signals, lose_patience, tell


def main() -> None:
    """Run the command line."""
    try:
        heed_signals()
        lose_patience()
        from endotwin.cli.main import main as run

        run()
    except Stopped as stopped:
        sys.exit(tell(stopped))
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing is left to stop


if __name__ == "__main__":
    main()

"""Where the process of a command begins and ends: Ctrl-C is heeded before anything else is imported."""

import os
import signal
import sys
from types import FrameType


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, b"stopped; nothing was written\n")
    os._exit(128 + number)


signal.signal(signal.SIGINT, _leave)

from endotwin.cli.stop import Stopped, end, end_if_told, heed_signals, lose_patience, tell  # noqa: E402


def main() -> None:
    """Run the command line."""
    code = 0
    try:
        heed_signals()
        lose_patience()
        from endotwin.cli.main import main as run

        run()
    except Stopped as stopped:
        code = tell(stopped)
    except SystemExit as ended:
        code = ended.code or 0
    finally:
        end_if_told()
    end(code)
    sys.exit(code)


if __name__ == "__main__":
    main()

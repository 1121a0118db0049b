"""The command line, run in the tests' own process."""

import sys

import pytest
from endotwin.cli.main import main


def invoke(*arguments: object) -> int:
    """Run the command line; its exit code. Anything but SystemExit fails the test."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as exit_:
        patch.setattr(sys, "argv", ["endotwin", *map(str, arguments)])
        main()
    return exit_.value.code or 0

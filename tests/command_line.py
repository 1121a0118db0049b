"""The command line, run in the tests' own process."""

import io
import sys
from contextlib import chdir, redirect_stdout
from subprocess import CompletedProcess
from types import SimpleNamespace

import pytest
from endotwin.cli.main import main


def invoke(*arguments: object) -> int:
    """Run the command line; its exit code. Anything but SystemExit fails the test."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as exit_:
        patch.setattr(sys, "argv", ["endotwin", *map(str, arguments)])
        main()
    return exit_.value.code or 0


def in_one_process(patch: pytest.MonkeyPatch) -> None:
    """Commands that ``tradeoff`` runs in processes of their own run in this one: they need not start, and
    are killed with it."""

    def run(command, cwd, **_) -> CompletedProcess:
        with chdir(cwd), redirect_stdout(io.StringIO()) as out:
            code = invoke(*command[3:])
        return CompletedProcess(command, code, out.getvalue(), "")

    patch.setattr("endotwin.tradeoff.measure.subprocess", SimpleNamespace(run=run))

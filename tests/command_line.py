"""The command line, run in the tests' own process, or several commands in one other."""

import io
import subprocess
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


CHILD = """
import sys
from endotwin.cli import start

start.end = lambda code: None
codes = []
for command in sys.argv[1:]:
    sys.argv = ["endotwin", *command.split("\x1f")]
    code = 0
    try:
        start.main()
    except SystemExit as done:
        code = done.code or 0
    codes.append(code)
    print("\x1e", end="", flush=True)
print(*codes, file=sys.stderr)
"""


def in_one_child(*commands: list[object], python: tuple[str, ...] = (), first: str = "", **options):
    """Run ``commands`` one after the other in one process, after the code ``first``; what it gave in bytes,
    and their exit codes."""
    asked = ["\x1f".join(map(str, command)) for command in commands]
    done = subprocess.run(
        [sys.executable, *python, "-c", first + CHILD, *asked], capture_output=True, check=False, **options
    )
    assert done.returncode == 0, done.stderr.decode()
    return done, [int(code) for code in done.stderr.decode().splitlines()[-1].split()]

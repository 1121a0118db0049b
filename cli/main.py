"""The ``endotwin`` command. Errors that a user can mend end here, as one line and exit code 2."""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from endotwin.cli.align import align
from endotwin.cli.check import check
from endotwin.cli.effects import effects
from endotwin.cli.eval import evaluate
from endotwin.cli.export import export
from endotwin.cli.fit import fit
from endotwin.cli.fuse import fuse
from endotwin.cli.inspect import inspect
from endotwin.cli.plain import spell_out
from endotwin.cli.selfcheck import selfcheck
from endotwin.cli.stop import Stopped, heed_signals, tell
from endotwin.cli.study import study
from endotwin.cli.synth import synth
from endotwin.cli.tradeoff import tradeoff

from endotwin.errors import EndotwinError

app = typer.Typer(
    name="endotwin",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for name, function in {
    "fuse": fuse,
    "align": align,
    "fit": fit,
    "eval": evaluate,
    "synth": synth,
    "inspect": inspect,
    "export": export,
    "effects": effects,
    "check": check,
    "selfcheck": selfcheck,
    "tradeoff": tradeoff,
}.items():
    app.command(name)(function)
app.add_typer(study, name="study")

(USAGE_ERRORS,) = typer.BadParameter.__bases__
"""Of any option: unknown, missing, of a wrong type or out of its range."""


def _show_version(wanted: bool) -> None:
    if wanted:
        import endotwin

        print(f"endotwin {endotwin.__version__}")
        raise typer.Exit


@app.callback()
def describe(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Turn a posed endoscopic RGB-D sequence into a relightable twin, and the twin into labelled datasets.

    The usual order: fuse, fit (which aligns the photos where that helps), eval, synth; inspect at any time.
    'endotwin COMMAND --help' explains each.
    """


def _usage(error: typer.BadParameter) -> str:
    """What is wrong with the command line, and where its options are explained."""
    command = error.ctx.command_path if error.ctx else "endotwin"
    return f"{error.format_message().rstrip('.')}; see '{command} --help'"


def main() -> None:
    """Run the command line; exit code 2 and one line on stderr for every error that a user can mend."""
    heed_signals()
    spell_out()
    try:
        sys.exit(app(sys.argv[1:] or ["--help"], standalone_mode=False))
    except USAGE_ERRORS as error:
        print("error:", _usage(error), file=sys.stderr)
        sys.exit(2)
    except EndotwinError as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)
    except OSError as error:  # the disk is full, a folder became read-only
        print(
            f"error: {error.filename or 'a file'} cannot be read or written ({error.strerror})",
            file=sys.stderr,
        )
        sys.exit(2)
    except Stopped as stopped:
        sys.exit(tell(stopped))


if __name__ == "__main__":
    main()

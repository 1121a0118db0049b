"""Odd values of every option of every command: done, or one sentence; no traceback, nothing left."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import tube_sequence
import typer
from command_line import invoke
from endotwin.cli.main import app
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytestmark = pytest.mark.slow

VALID = {
    "fuse": "fuse tube -o out",
    "align": "align twin -o out",
    "fit": "fit twin -o out --budget 0.1",
    "eval": "eval twin",
    "synth": "synth twin --trajectory jitter:frames=1 -o out --workers 1",
    "inspect": "inspect twin --screenshot out.png --map coverage",
    "export": "export twin out.ply",
    "effects": "effects twin",
    "check": "check tube",
    "selfcheck": "selfcheck",
    "tradeoff": "tradeoff other -o out --rungs draft --repeats 1",
    "study depth": "study depth --real tube --twin twin --test other -o out --network small --frames 2",
}
"""A command line of each command that does its work."""

LONG = ("endotwin.tradeoff.run.measured", "endotwin.study.run.train", "endotwin.selfcheck.run_checks")
"""Where work begins that takes minutes."""

ODD = [
    "",
    " ",
    "-",
    "-1",
    "0",
    "0.5",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "9" * 30,
    "x",
    "ä/ö",
    "a=b",
    "=",
    ",",
    ":",
]
ODD += [
    "on",
    "=on",
    "gain=",
    "gain=2",
    "tube",
    "twin/twin.json",
    "tube/pose.txt",
    "tube/camera.json",
    "/",
    ".",
]
ODD += [
    "/dev/null",
    "0x0",
    "1x1",
    "640x",
    "jitter:",
    "jitter:frames=nan",
    "roughness*nan",
    "x" * 300,
    "💡",
    "%s",
]

TREE = typer.main.get_command(app)


def commands(group: click.Group, prefix: str = "") -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{prefix}{name} ")
        else:
            yield prefix + name, command


OPTIONS = [
    (name, option.opts[-1])
    for name, command in commands(TREE)
    for option in command.params
    if option.param_type_name == "option" and not option.is_flag and not option.is_eager
]


class Begun(BaseException):
    """The long work starts."""


def begin(*_: object, **__: object) -> None:
    raise Begun


@pytest.fixture(scope="module")
def here(made) -> Iterator[Path]:
    tube_sequence.write(made / "other", 3, 40, 30)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        for work in LONG:
            patch.setattr(work, begin)
        yield made


def test_every_command_is_tried():
    assert {name for name, _ in commands(TREE)} == set(VALID)
    assert len(OPTIONS) > 50


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(option=st.sampled_from(OPTIONS), odd=st.sampled_from(ODD))
def test_an_odd_value_of_any_option_is_heeded_or_refused_in_one_sentence(here, capfd, option, odd):
    command, flag = option
    before = set(here.rglob("*"))
    capfd.readouterr()
    try:
        code = invoke(*VALID[command].split(), flag, odd)
    except Begun:
        return
    finally:
        new = set(here.rglob("*")) - before
        for path in new:
            if path.parent not in new:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    said = capfd.readouterr().err.splitlines()
    assert code in (0, 2), said
    if code:
        assert said and said[-1].startswith("error: ") and not new, said
        assert not [line for line in said[:-1] if not line.startswith("warning: ")], said

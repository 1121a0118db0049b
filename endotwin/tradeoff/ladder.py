"""The ladder: which ways to spend time are compared."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path

from endotwin.config import DEFAULT, SUFFIXES, Config, from_document, load_config, preset_names, to_yaml
from endotwin.effects import NAMES, parse_states
from endotwin.errors import OptionError
from endotwin.run.yamltext import parsed

LADDER = (
    "draft",
    "scale=0.35",
    "scale=0.5",
    "scale=0.7",
    "voxel=3",
    "voxel=2",
    "voxel=1.4",
    "pixels=500000",
    "pixels=1000000",
    "detail=2",
    "steps=0",
    "steps=1",
    "tilts=0",
    "budget=8s",
    "budget=16s",
    "standard",
    "fine",
)
"""Presets, and one knob at a time away from ``standard``."""

ENDOPBR = "method=endopbr+budget={}"


@dataclass(frozen=True)
class Rung:
    """One way to spend time.

    Attributes:
        name: a preset, a file's stem, or ``key=value`` changes of a preset joined by ``+``.
        config: what it means.
        given: what ``--config`` takes to get it, or None where it needs a file of its own.
        effects: what ``--effects`` takes beside it.
    """

    name: str
    config: Config
    given: str | None
    effects: str = ""

    @property
    def knob(self) -> str:
        """What the rung turns: ``preset``, ``file``, or the first changed key."""
        if "=" in self.name:
            changes = [part for part in self.name.split("+") if "=" in part]
            return "endopbr" if self.config.fit.method == "endopbr" else changes[0].split("=")[0]
        return "preset" if self.name in preset_names() else "file"

    def forcing(self, effect: str, state: str) -> Rung:
        """This rung with one effect forced to ``state``."""
        change = f"{effect}={state}"
        config = replace(self.config, effects={**self.config.effects, effect: state})
        effects = ",".join(filter(None, [self.effects, change]))
        return Rung(f"{self.name}+{change}", config, self.given, effects)

    def commands(self, sequence: Path, config: str, geometry: str, seed: int = 0) -> list[list[str]]:
        """The arguments of fuse, fit and eval that make and score this rung's twin."""
        protocol = [] if geometry == "known" else ["--geometry", geometry]
        chosen = [] if config == DEFAULT else ["--config", config]
        forced = ["--effects", self.effects] if self.effects else []
        return [
            ["fuse", str(sequence), "-o", "twin", *protocol, *chosen],
            ["fit", "twin", *chosen, *forced, "--seed", str(seed)],
            ["eval", "twin", "--json", *([] if self.config.fuse.scale == 1 else ["--scale", "1"])],
        ]


def shell(arguments: list[str]) -> str:
    """An endotwin command as one types it."""
    return shlex.join(["endotwin", *arguments])


def one_line(commands: list[list[str]]) -> str:
    """The commands of a rung as one line of shell."""
    return " && ".join(shell(command) for command in commands)


def ladder(names: str | None, endopbr_budget: str) -> list[Rung]:
    """The rungs named in ``names`` (joined by commas); the whole ladder and ``endopbr`` unless given.

    Raises:
        OptionError: a name that means nothing, or appears twice.
    """
    chosen = [name.strip() for name in names.split(",")] if names else list(LADDER)
    if not names:
        chosen.append(ENDOPBR.format(endopbr_budget))
    rungs = [rung(ENDOPBR.format(endopbr_budget) if name == "endopbr" else name) for name in chosen]
    for number, one in enumerate(rungs):
        if one.name in [other.name for other in rungs[:number]]:
            raise OptionError(f"rung '{one.name}' is named twice in --rungs; name it once")
    return rungs


def rung(name: str) -> Rung:
    """The rung of that name: ``draft``, ``mine.yaml``, ``steps=1``, ``draft+voxel=2+gain=on``."""
    first, *rest = [name] if Path(name).suffix in SUFFIXES else name.split("+")
    own = Path(first).suffix in SUFFIXES
    base, changes = (DEFAULT, [first, *rest]) if "=" in first and not own else (first, rest)
    effects = [change for change in changes if change.partition("=")[0] in NAMES]
    knobs = [change for change in changes if change not in effects]
    if knobs:
        title = knobs if knobs[0] == first else [Path(base).stem if own else base, *knobs]
        made = Rung("+".join(title), _turned(base, knobs, name), None)
    elif own:
        made = Rung(Path(base).stem, load_config(base), str(Path(base).resolve()))
    else:
        made = Rung(base, load_config(base), base)
    for effect, state in parse_states(",".join(effects)).items():
        made = made.forcing(effect, state)
    return made


def _turned(base: str, knobs: list[str], name: str) -> Config:
    """The config ``base`` with ``knobs`` turned, for the rung ``name``."""
    document = parsed(to_yaml(load_config(base)))
    parts = [part for part in fields(Config) if is_dataclass(part.default_factory)]
    homes = {key.name: part.name for part in parts for key in fields(part.default_factory)}
    for knob in knobs:
        key, _, value = knob.partition("=")
        if key not in homes:
            raise OptionError(
                f"rung '{name}' turns '{key}', which is no knob; the knobs are {', '.join(homes)}, and the "
                f"effects {', '.join(NAMES)}"
            )
        try:
            document[homes[key]][key] = parsed(value)
        except ValueError as error:
            raise OptionError(f"rung '{name}': {value!r} is no value of '{key}' ({error})") from error
    return from_document(document, f"rung '{name}'")

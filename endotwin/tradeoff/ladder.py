"""The ladder: which ways to spend time are compared."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import yaml

from endotwin.config import DEFAULT, SUFFIXES, Config, from_document, load_config, preset_names, to_yaml
from endotwin.errors import OptionError

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
    """

    name: str
    config: Config
    given: str | None

    @property
    def knob(self) -> str:
        """What the rung turns: ``preset``, ``file``, or the first changed key."""
        if "=" in self.name:
            changes = [part for part in self.name.split("+") if "=" in part]
            return "endopbr" if self.config.fit.method == "endopbr" else changes[0].split("=")[0]
        return "preset" if self.name in preset_names() else "file"

    def commands(self, sequence: Path, config: str, geometry: str, seed: int = 0) -> list[list[str]]:
        """The arguments of fuse, fit and eval that make and score this rung's twin."""
        protocol = [] if geometry == "known" else ["--geometry", geometry]
        chosen = [] if config == DEFAULT else ["--config", config]
        return [
            ["fuse", str(sequence), "-o", "twin", *protocol, *chosen],
            ["fit", "twin", *chosen, "--seed", str(seed)],
            ["eval", "twin", "--json", *([] if self.config.fuse.scale == 1 else ["--scale", "1"])],
        ]


def shell(arguments: list[str]) -> str:
    """An endotwin command as one types it."""
    return shlex.join(["endotwin", *arguments])


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
    """The rung of that name: ``draft``, ``mine.yaml``, ``steps=1``, ``draft+voxel=2``."""
    if Path(name).suffix in SUFFIXES:
        return Rung(Path(name).stem, load_config(name), str(Path(name).resolve()))
    first, *rest = name.split("+")
    base, changes = (DEFAULT, [first, *rest]) if "=" in first else (first, rest)
    if not changes:
        return Rung(name, load_config(base), base)
    document = yaml.safe_load(to_yaml(load_config(base)))
    parts = [part for part in fields(Config) if is_dataclass(part.default_factory)]
    homes = {key.name: part.name for part in parts for key in fields(part.default_factory)}
    for change in changes:
        key, _, value = change.partition("=")
        if key not in homes:
            raise OptionError(
                f"rung '{name}' turns '{key}', which is no knob; the knobs are {', '.join(homes)}"
            )
        document[homes[key]][key] = yaml.safe_load(value)
    return Rung(name, from_document(document, f"rung '{name}'"), None)

"""Effect by effect: what a twin gains and costs by each, beside the evidence that decided it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from endotwin.effects import FITTED, RENDERED, Decision
from endotwin.effects.exposure import following
from endotwin.errors import OptionError
from endotwin.render import Renderer
from endotwin.render.price import best_ms, frame_ms
from endotwin.run.output import TWIN
from endotwin.sequence import Sequence
from endotwin.surface.casting import Caster
from endotwin.synth.photograph import photographed
from endotwin.synth.variation.switches import equipped
from endotwin.tradeoff.ladder import Rung, rung
from endotwin.tradeoff.measure import due, keep, kept, measured, timed
from endotwin.tradeoff.summary import summary
from endotwin.twin import Twin

AS_DECIDED = "as decided"
"""The case in which no effect is forced."""

ADDED = {
    "psnr_gain": "psnr",
    "psnr_covered_gain": "psnr_covered",
    "ssim_gain": "ssim",
    "seconds_added": "seconds",
    "peak_memory_added_mb": "peak_memory_mb",
}
"""What an effect adds to the columns of ``summary``."""


def base(name: str) -> Rung:
    """The rung ``name``, with whose fit those with an effect forced are compared.

    Raises:
        OptionError: no such rung, one that decides no effects, or one whose fits all take the same time.
    """
    chosen = rung(name)
    if chosen.config.fit.method != "twin":
        raise OptionError(f"'{name}' in --effects fits no effects; name a rung of the method twin")
    if chosen.config.fit.budget is not None:
        raise OptionError(
            f"'{name}' in --effects has a budget, in which every effect costs the same seconds; name a rung "
            f"without, or add +budget=null"
        )
    return chosen


def forced(base: Rung, decisions: dict[str, Decision]) -> dict[str, Rung]:
    """By fitted effect, ``base`` with it forced to what was not decided; no guide, no shadow to force."""
    flipped = {"on": "off", "off": "on"}
    lit_from_lens = decisions["offset"].state == "off"
    return {
        name: base.forcing(name, flipped[decisions[name].state])
        for name in FITTED
        if not (name == "shadows" and lit_from_lens)
    }


def measure(
    base: Rung,
    sequence: Sequence,
    repeats: int,
    geometry: str,
    work: Path,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, Rung]:
    """Fuse once, fit ``base`` and then each of ``forced``; results go to ``work`` and are found again there.

    Returns:
        the rungs, by effect; ``base`` as AS_DECIDED.
    """
    for folder in ("rungs", "results"):
        (work / folder).mkdir(parents=True, exist_ok=True)
    for repeat in range(repeats):
        for done, (effect, case) in enumerate(_cases(base, work)):
            if progress:
                progress(f"effects: {case.name}, run {repeat + 1} of {repeats}", done, 1 + len(FITTED))
            _measure(case, repeat, sequence, geometry, work, effect == AS_DECIDED and repeat == 0)
    return dict(_cases(base, work))


def _cases(base: Rung, work: Path) -> Iterator[tuple[str, Rung]]:
    """``base``, and once that is measured, what its decisions leave to force."""
    yield AS_DECIDED, base
    yield from forced(base, decisions(base, work)).items()


def decisions(rung: Rung, work: Path) -> dict[str, Decision]:
    """What the first fit of a rung decided."""
    result = json.loads((work / "results" / f"{rung.name}.0.json").read_text(encoding="utf-8"))
    return {name: Decision(**decision) for name, decision in result["effects"].items()}


def _measure(
    case: Rung, repeat: int, sequence: Sequence, geometry: str, work: Path, rendered_too: bool
) -> None:
    """Measure one fit and keep it, unless that was done; ``rendered_too``: price what no fit needs."""
    if (run := due(case, repeat, work)) is None:
        return
    result, asked, config = run
    files, whole = [*sequence.color_files, *sequence.depth_files], work.resolve()
    fuse, fit, score = case.commands(sequence.path.resolve(), config, geometry, repeat)
    fused = {"fuse": asdict(case.config.fuse)}
    if not (kept(work / "fused.json", fused) and (work / "fused" / TWIN).exists()):
        shutil.rmtree(work / "fused", ignore_errors=True)
        timed([*fuse[:2], "-o", "fused", *fuse[4:]], files, whole)
        keep(fused, work / "fused.json")
    measurement = measured([["fit", "fused", "-o", "twin", *fit[2:]], score], files, whole)
    twin = Twin.load(work / "twin")
    found = {name: asdict(decision) for name, decision in twin.decisions.items()}
    if rendered_too:
        for name, milliseconds in rendered_ms(twin).items():
            found[name]["render_ms"] = milliseconds
    poses = twin.sequence().T_world_camera
    pose = poses[len(poses) // 2]
    keep({**asked, **measurement, "effects": found, "frame_ms": frame_ms(Renderer(twin), pose)}, result)


def rendered_ms(twin: Twin) -> dict[str, float]:
    """Milliseconds that each effect that no fit needs adds to that frame, as strong as in the sequence."""
    twin, poses = replace(twin, effects=twin.effects.without(RENDERED)), twin.sequence().T_world_camera
    middle, caster, costs = len(poses) // 2, Caster(twin.surface), {}
    moving = poses[middle], following(poses)[middle], np.random.default_rng(0)
    for name in RENDERED:
        renderer = Renderer(equipped(twin, {name: "on"}, trajectory=""), caster=caster)
        view = renderer.view(poses[middle])
        with suppress(OptionError):  # without a recorder there is nothing to pay
            costs[name] = round(best_ms(partial(photographed, renderer, view, *moving)), 1)
    return costs


def rows(
    cases: dict[str, Rung], repeats: int, work: Path, out: Path, path: Path, geometry: str
) -> list[dict]:
    """What was decided, then one row an effect.

    Returns:
        the columns of ``summary`` for the fit with the effect forced (those only rendered have none), and
        ``{"effect", "state", "reason", "probe_db": as decided, "render_ms", "memory_mb": its price, ADDED...:
        with the effect less without, "forced": the state that forcing it led to, "also": those that changed
        with it, "frame_ms": of the twin with the effect forced}``.
    """
    measured = {
        effect: summary(case, repeats, work, out, path, geometry, ("frame_ms",))
        for effect, case in cases.items()
    }
    decided, plain = decisions(cases[AS_DECIDED], work), measured.pop(AS_DECIDED)
    table = [{"effect": AS_DECIDED, **plain}]
    for effect, row in measured.items():
        found = decisions(cases[effect], work)
        evidence = decided[effect]
        having, lacking, price = (
            (plain, row, evidence) if evidence.state == "on" else (row, plain, found[effect])
        )
        changed = {name: found[name].state for name in FITTED if found[name].state != decided[name].state}
        told = _evidence(effect, evidence, price)
        told |= {name: having[column] - lacking[column] for name, column in ADDED.items()}
        told["forced"] = changed.pop(effect, evidence.state)
        told["also"] = ", ".join(f"{name} {state}" for name, state in changed.items())
        table.append({**told, **row})
    return table + [_evidence(effect, decided[effect], decided[effect]) for effect in RENDERED]


def _evidence(effect: str, decided: Decision, price: Decision) -> dict:
    return {
        "effect": effect,
        "state": decided.state,
        "reason": decided.reason,
        "probe_db": "" if decided.gain_db is None else decided.gain_db,
        "render_ms": price.render_ms,
        "memory_mb": price.memory_mb,
    }

"""Effects switched on or off for a rendering, and edits of their parameters."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace

import numpy as np

from endotwin.effects import FITTED, NAMES, RENDERED, Effects, checked_states, effect_class
from endotwin.effects.offset import Offset
from endotwin.effects.shadows import Shadows
from endotwin.errors import OptionError
from endotwin.light.guides import AT_LENS
from endotwin.sequence.readers import open_sequence
from endotwin.synth.variation.edits import OFFSETS, Edit, limits
from endotwin.twin import Twin

logger = logging.getLogger("endotwin")

SUCCESSIVE = ("motion_blur", "rolling_shutter", "interlacing", "auto_gain")


def parameter_names() -> tuple[str, ...]:
    """``EFFECT.PARAMETER`` of all that can be edited."""
    return tuple(f"{name}.{each.name}" for name in NAMES for each in effect_class(name).parameters())


def switched(effects: Effects, switches: Iterable[tuple[str, bool]]) -> Effects:
    """The effects after some are switched on or off; one that the twin lacks comes with its defaults."""
    for name, on in switches:
        if not on:
            effects = effects.without([name])
        elif name not in effects:
            effects = effects.including(effect_class(name)())
    return effects


def equipped(twin: Twin, states: Mapping[str, str], trajectory: object) -> Twin:
    """The twin with effects on or off as ``states`` say, as strong as its sequence shows them to be.

    Under the name ``like`` stands the path of another sequence, whose strengths are taken instead; what its
    photos show is on unless a state says otherwise, or it needs a velocity that the trajectory lacks.

    Raises:
        OptionError: an effect that only a fit can turn on or decide, or blur of a trajectory without a
            velocity. SequenceError: there is no such sequence.
    """
    states = checked_states(states, like=True)
    like = states.pop("like", None)
    sequence = None if like is None else open_sequence(like)
    undecided = [name for name, state in states.items() if state == "auto"]
    if undecided:
        raise OptionError(
            f"{undecided[0]}=auto is for 'endotwin fit', which decides; write {undecided[0]}=on or off here"
        )
    effects = twin.effects.without([name for name, state in states.items() if state == "off"])
    still = SUCCESSIVE if str(trajectory).partition(":")[0] == "jitter" else ()
    if sequence is not None:
        asked = [name for name in RENDERED if name not in states and name not in still]
        shown = [effect for name in asked if (effect := effect_class(name).evidence(sequence)[0])]
        for effect in shown:
            effects = effects.including(effect)
        told = [effect.name for effect in shown]
        silent = [name for name in asked if name not in told]
        logger.warning(
            "the photos of %s tell of %s; of %s they do not, so those are as the twin has them",
            *(like, " and ".join(told) or "no effect", ", ".join(silent)),
        )
    for name, state in states.items():
        if state != "on" or name in effects:
            continue
        if name in FITTED and name not in ("coat", "sparkle"):
            raise OptionError(f"the twin has no {name}; a fit with its effect {name} on finds it")
        if name in still:
            raise OptionError(f"{name} needs poses that follow each other, and those of jitter do not")
        found = effect_class(name).evidence(sequence or twin.sequence())[0] if name in RENDERED else None
        effects = effects.including(found or effect_class(name)())
    return replace(twin, effects=effects)


def require_switchable(name: str, effects: Effects) -> None:
    """Raise OptionError for an effect that cannot be switched on, since its parameters have no defaults."""
    if name not in effects and not effect_class(name).parameters() and fields(effect_class(name)):
        raise OptionError(f"the twin has no effect {name!r}, which has no defaults; it can only be off")


def edit_effects(effects: Effects, edits: Iterable[Edit]) -> Effects:
    """The effects after edits ``EFFECT.PARAMETER…``, each within its bounds; those that are off stay off."""
    for edit in edits:
        name, _, parameter = edit.name.partition(".")
        if name in effects:
            value = np.clip(edit.apply(getattr(effects[name], parameter)), *limits(edit.name))
            effects = effects.including(replace(effects[name], **{parameter: float(value)}))
    return effects


def edit_offset(effects: Effects, edits: Iterable[Edit]) -> Effects:
    """The effects after edits ``offset.x``, ``.y`` or ``.z`` (mm) of every light guide's place.

    Light that was at the lens casts shadows once it is beside it.
    """
    moves = [edit for edit in edits if edit.name in OFFSETS]
    if not moves:
        return effects
    guides_mm = np.array(effects.guides_mm or AT_LENS)
    for edit in moves:
        axis = OFFSETS.index(edit.name)
        guides_mm[:, axis] = edit.apply(guides_mm[:, axis])
    if "offset" not in effects:
        effects = effects.including(Shadows())
    return effects.including(Offset(tuple(tuple(map(float, guide)) for guide in guides_mm)))

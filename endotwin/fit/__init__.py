"""Materials, light and response from photos, on a known surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from endotwin.config import METHODS, STANDARD, FitConfig
from endotwin.effects import RENDERED, checked_states
from endotwin.errors import OptionError
from endotwin.pixels.pace import Pace
from endotwin.run.threads import device_of
from endotwin.twin import Twin

if TYPE_CHECKING:
    from endotwin.fit.solve import Price


def fit(
    twin: Twin,
    config: FitConfig = STANDARD.fit,
    epochs: int | None = None,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
    checkpoint: Path | None = None,
    effects: Mapping[str, str] | None = None,
    price: Price = lambda twin, caster, views, radiosity: twin,
    device: str = "cpu",
) -> Twin:
    """The twin with materials, light and response fitted to its training photos.

    Args:
        config: the method, and how much work it may do.
        epochs: passes over the training images, ``endopbr`` only.
        seed: of every random choice.
        progress: called with (label, done, total).
        checkpoint: where ``endopbr`` keeps what it has learned so far, to go on from there if it is stopped.
        effects: auto, on or off by name of the effect, ``twin`` only; auto unless named.
        price: gives the fitted twin's decisions what each effect costs a rendering of the training views,
            ``twin`` only.
        device: cpu, cuda, or auto for a GPU where there is one.

    Raises:
        OptionError: an unknown method, effect or state, an option that the method does not have, or an effect
            that no fit can be told to find.
        SequenceError: the photos cannot be read, or show nothing of the surface.
    """
    if config.method not in METHODS:
        raise OptionError(f"unknown method '{config.method}'; choose one of: {', '.join(METHODS)}")
    place, states = device_of(device), checked_states(effects or {})
    rendered = [name for name, state in states.items() if name in RENDERED and state == "on"]
    if rendered:
        raise OptionError(
            f"{rendered[0]} cannot be forced on in a fit; ask for it with 'synth --effects {rendered[0]}=on'"
        )
    if config.method == "twin":
        if epochs is not None:
            raise OptionError(
                "epochs belong to the method endopbr; bound the method twin by a budget of seconds"
            )
        from endotwin.fit.solve import fit_twin

        return fit_twin(twin, Pace(config, progress), seed, states, price, place)
    if states:
        raise OptionError(
            "effects belong to the method twin; endopbr is Han & Wu's model as published, without effects"
        )
    from endotwin.fit.endopbr import fit_endopbr

    return fit_endopbr(twin, config.budget, epochs, seed, progress, checkpoint, place)

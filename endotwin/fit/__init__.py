"""Materials, light and response from photos, on a known surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from endotwin.errors import OptionError
from endotwin.fit.solve import fit_twin
from endotwin.twin import Twin

METHODS = ("twin", "endopbr")


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    Attributes:
        method: ``twin``, or ``endopbr`` (Han & Wu 2025 as published).
        budget_s: bound on the wall-clock seconds; None: until it converges (twin) or ``epochs`` are done
            (endopbr).
        epochs: passes over the training images, ``endopbr`` only.
        seed: of every random choice.
    """

    method: str = "twin"
    budget_s: float | None = None
    epochs: int | None = None
    seed: int = 0


def fit(
    twin: Twin, options: FitOptions = FitOptions(), progress: Callable[[str, int, int], None] | None = None
) -> Twin:
    """The twin with materials, light and response fitted to its training photos.

    Raises:
        OptionError: an unknown method, or an option that the method does not have.
        SequenceError: the photos cannot be read, or show nothing of the surface.
    """
    if options.method not in METHODS:
        raise OptionError(f"unknown method '{options.method}'; choose one of: {', '.join(METHODS)}")
    if options.method == "twin":
        if options.epochs is not None:
            raise OptionError(
                "--epochs belongs to --method endopbr; bound the method twin with --budget SECONDS"
            )
        return fit_twin(twin, options.budget_s, options.seed, progress)
    from endotwin.fit.endopbr import fit_endopbr

    return fit_endopbr(twin, options.budget_s, options.epochs, options.seed, progress)

"""A sequence's whole way, fuse → fit → eval, and what can be said of it."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from endotwin.config import STANDARD, FitConfig
from endotwin.errors import EndotwinError
from endotwin.evaluation import Evaluation, evaluate
from endotwin.pipeline import fit_twin, fuse_twin
from endotwin.selfcheck.tube import Damage, Tube, flight
from endotwin.twin import Twin


@dataclass(frozen=True)
class Journey:
    """How far a sequence came.

    Attributes:
        twin, scores: None where ``refused`` tells in one sentence why there is none.
        said: the warnings, one a line.
    """

    twin: Twin | None
    scores: Evaluation | None
    said: str
    refused: str = ""

    @property
    def not_finite(self) -> int:
        """NaN and Inf among all that the twin holds."""
        twin = self.twin
        surface, light = twin.surface, twin.light
        constants = [light.L0, light.n, light.q, twin.response.gamma, twin.materials.f0]
        arrays = [surface.vertices_mm, surface.normals, surface.origin_mm]
        arrays += [*twin.materials.per_vertex.values(), np.array(constants)]
        return sum(int((~np.isfinite(array)).sum()) for array in arrays)


def travel(
    tube: Tube | None = None,
    poses: np.ndarray | None = None,
    damage: Damage | None = None,
    seed: int = 0,
    config: FitConfig = STANDARD.fit,
) -> Journey:
    """``tube`` photographed from ``poses`` with ``damage``, fused, fitted and scored on held-out photos."""
    with tempfile.TemporaryDirectory() as folder, warnings_said() as said:
        twin = scores = None
        try:
            path = (tube or Tube()).write(Path(folder) / "tube", flight() if poses is None else poses, damage)
            twin = fit_twin(fuse_twin(path), seed=seed, config=config)
            scores = evaluate(twin) if len(twin.source.heldout(len(twin.source.open()))) else None
        except EndotwinError as error:
            return Journey(None, None, "\n".join(said), str(error))
        return Journey(twin, scores, "\n".join(said))


@contextmanager
def warnings_said() -> Iterator[list[str]]:
    """The warnings that endotwin logs in the block, which are not shown."""
    said: list[str] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    logger, keep = logging.getLogger("endotwin"), Keep(logging.WARNING)
    handlers, propagate = logger.handlers, logger.propagate
    logger.handlers, logger.propagate = [keep], False
    try:
        yield said
    finally:
        logger.handlers, logger.propagate = handlers, propagate

"""A long training on disk: written whole now and then, so that the same command can go on from there."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from endotwin.run.output import whole_file
from endotwin.twin import Twin

EVERY_S = 60.0


class Checkpoint:
    """Parameters and Adam's moments of one training.

    Args:
        path: the file; None: nothing is kept.
        identity: what the training depends on. A file of another one is not gone on from, and is replaced.
    """

    def __init__(self, path: Path | None, identity: str, optimizer: torch.optim.Adam):
        self._path, self._identity, self._optimizer = path, identity, optimizer
        self._parameters = [each for group in optimizer.param_groups for each in group["params"]]
        self._written = time.perf_counter()

    def resume(self, most: int) -> tuple[int, float]:
        """Steps done and seconds spent by the training that was stopped, its state restored; 0 and 0.0 if
        there is none of at most so many steps."""
        if self._path is None or not self._path.exists():
            return 0, 0.0
        try:
            with safe_open(self._path, "pt") as file:
                about = file.metadata()
                step, seconds = int(about["step"]), float(about["seconds"])
                if about["identity"] != self._identity or step > most:
                    return 0, 0.0
                kept = [self._kept(file, number) for number in range(len(self._parameters))]
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError):
            return 0, 0.0  # damaged: the training starts anew
        self._restore(kept, step)
        return step, seconds

    def keep(self, step: int, seconds: float) -> None:
        """Write the state after ``step`` if the last time was EVERY_S seconds ago."""
        if self._path is None or time.perf_counter() - self._written < EVERY_S:
            return
        tensors = {}
        for number, parameter in enumerate(self._parameters):
            moments = self._optimizer.state[parameter]
            tensors[f"{number}.value"] = parameter.detach()
            tensors[f"{number}.exp_avg"], tensors[f"{number}.exp_avg_sq"] = (
                moments["exp_avg"],
                moments["exp_avg_sq"],
            )
        about = {"identity": self._identity, "step": str(step), "seconds": repr(seconds)}
        with whole_file(self._path, overwrite=True) as file:
            file.write_bytes(save(tensors, about))
        self._written = time.perf_counter()

    @contextmanager
    def told_when_stopped(self) -> Iterator[None]:
        """Whoever stops the block is told that it can go on."""
        try:
            yield
        except BaseException as stop:
            if self._path is not None and self._path.exists():
                stop.add_note("nothing was written yet; the same command goes on from here")
            raise

    def remove(self) -> None:
        """The training is done."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _kept(self, file: safe_open, number: int) -> list[torch.Tensor]:
        """Value and both moments of parameter ``number``, of its shape and on its device."""
        parameter = self._parameters[number]
        tensors = (file.get_tensor(f"{number}.{name}") for name in ("value", "exp_avg", "exp_avg_sq"))
        return [tensor.reshape(parameter.shape).to(parameter.device) for tensor in tensors]

    def _restore(self, kept: list[list[torch.Tensor]], step: int) -> None:
        with torch.no_grad():
            for parameter, (value, mean, square) in zip(self._parameters, kept, strict=True):
                parameter.copy_(value)
                moments = {"step": torch.tensor(float(step)), "exp_avg": mean, "exp_avg_sq": square}
                self._optimizer.state[parameter] = moments


def identity(twin: Twin, *settings: object) -> str:
    """A digest of the surface, the photos' places and ``settings``: equal for the same training, and only
    then."""
    moved = twin.registration and asdict(twin.registration)
    described = json.dumps([asdict(twin.source), twin.camera.to_dict(), moved, *settings])
    digest = hashlib.sha256(described.encode())
    digest.update(twin.surface.vertices_mm.tobytes())
    digest.update(twin.surface.triangles.tobytes())
    return digest.hexdigest()

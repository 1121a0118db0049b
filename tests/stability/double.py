"""The fit in double precision: the same code, with float64 wherever it says or defaults to float32."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from endotwin.fit import gauss_newton, hashgrid, linear, mesh_pattern, prior, solve, tilt
from endotwin.fit import normal_equations as normal
from endotwin.pixels import start
from endotwin.pixels.samples import Samples

MODULES = (hashgrid, gauss_newton, linear, mesh_pattern, normal, prior, solve, start, tilt)


class DoubleNumpy:
    """NumPy whose float32 is float64."""

    float32 = np.float64

    def __getattr__(self, name: str) -> object:
        return getattr(np, name)


def in_double(patch: pytest.MonkeyPatch) -> None:
    """Make the fit double until ``patch`` is undone."""
    patch.setattr(torch.Tensor, "float", torch.Tensor.double)
    for module in MODULES:
        if hasattr(module, "np"):
            patch.setattr(module, "np", DoubleNumpy())
    gather = solve.gather

    def gathered(*arguments: object) -> Samples:
        samples = gather(*arguments)
        real = {name: value.double() for name, value in vars(samples).items() if _is_single(value)}
        return replace(samples, **real)

    patch.setattr(solve, "gather", gathered)
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    patch.callback = lambda: torch.set_default_dtype(default)


def _is_single(value: object) -> bool:
    return isinstance(value, torch.Tensor) and value.dtype == torch.float32

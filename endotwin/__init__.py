"""Posed endoscopic RGB-D sequences become relightable twins, and twins become labelled datasets.

The names below are imported when they are first used, so that ``import endotwin`` is instant.
"""

import importlib
import os

# Threads that wait should sleep: spinning ones take the cores from the threads that they wait for, and a fit
# beside another busy process took twice as long. The setting is read once, when torch loads its runtime.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_HOME = {
    "EndotwinError": "errors",
    "Evaluation": "evaluation",
    "Renderer": "render",
    "Sequence": "sequence",
    "Surface": "surface",
    "Twin": "twin",
    "align_twin": "pipeline",
    "evaluate": "evaluation",
    "fit_twin": "pipeline",
    "fuse_twin": "pipeline",
    "inspect": "look.inspector",
    "open_sequence": "sequence.readers",
    "synthesize": "pipeline",
    "with_fluids": "pipeline",
    "with_polyps": "pipeline",
}

__all__ = sorted(_HOME)


def __getattr__(name: str):
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("endotwin")
    if name not in _HOME:
        raise AttributeError(f"module 'endotwin' has no attribute {name!r}")
    return getattr(importlib.import_module(f"endotwin.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME, "__version__"])

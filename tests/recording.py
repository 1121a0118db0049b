"""What an effect on the recorded picture may change of a dataset: the file of rgb, and nothing else."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import tube_twin

import endotwin
import endotwin.synth
from endotwin.effects import Effect, Effects

LABELS = "rgb,rgb_linear,depth,normals,mask,diffuse"


def change_of_rgb_alone(folder: Path, recorded: Sequence[Effect]) -> float:
    """Mean change of rgb in levels of 255 by the effects ``recorded``; asserts that no other file changes and
    that the labels hold."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    poses = np.stack([tube_twin.pose(s) for s in (0.5, 0.52)])
    for name, effects in (("plain", []), ("recorded", recorded)):
        equipped = replace(twin, effects=Effects(effects))
        endotwin.synthesize(equipped, poses, folder / name, labels=LABELS)
    for file in (folder / "plain").glob("0001_*"):
        same = file.read_bytes() == (folder / "recorded" / file.name).read_bytes()
        assert same == (file.name != "0001_color.png"), file.name
    assert endotwin.synth.prove(folder / "recorded").holds
    one, other = (cv2.imread(str(folder / name / "0001_color.png")) for name in ("plain", "recorded"))
    return float(np.abs(one.astype(float) - other).mean())

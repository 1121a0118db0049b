"""The view through the scope: a twin from any pose, under any light, beside its photos.

Nothing here knows of windows: ``Scope`` is flown and turned by numbers, and draws arrays.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.cameras import Camera
from endotwin.effects.coat import Coat
from endotwin.errors import OptionError, SequenceError
from endotwin.evaluation import error_heat
from endotwin.render import Renderer, View
from endotwin.render.price import FREE, frame_ms
from endotwin.sequence import Sequence
from endotwin.surface.casting import surface_points
from endotwin.synth.trajectories.recorded import path_or_flight
from endotwin.twin import Twin

QUICK_PX = 320 * 240
"""Pixels of a view while the scope moves, at most."""

QUICK_MS = 100.0
"""A view that takes longer while the scope moves is drawn smaller the next time."""

SHRINK = (1.0, 0.75, 0.5, 0.35, 0.25)
SHADOW_SHARE = 0.015
"""A photo sees a point if a ray from its lens meets nothing nearer, but for this share of its length."""

INK, GROUND = (232, 232, 232), (0x14, 0x16, 0x1A)
FONT, LINE_PX, MARGIN_PX = 0.42, 18, 8


@dataclass(frozen=True)
class Knob:
    """Something to turn: what it is called, its range, and where the twin has it."""

    words: str
    low: float
    high: float
    value: float


@dataclass(frozen=True)
class Probe:
    """A point of the surface and what is known of it.

    Attributes:
        point_mm: world, [3]. normal: world, [3]. base_color: [3]. seen_by: training photos that see it.
        frames, photos, renders: index, photo's and twin's display value [N, 3] in each photo that sees it.
    """

    point_mm: np.ndarray
    normal: np.ndarray
    base_color: np.ndarray
    roughness: float
    metallic: float
    seen_by: float
    distance_mm: float
    frames: tuple[int, ...]
    photos: np.ndarray
    renders: np.ndarray

    def lines(self) -> list[str]:
        """The same in words."""

        def triple(values: np.ndarray, digits: int) -> str:
            return ", ".join(f"{value:.{digits}f}" for value in values)

        said = [
            f"point ({triple(self.point_mm, 2)}) mm, {self.distance_mm:.1f} mm from the lens",
            f"base colour ({triple(self.base_color, 3)}), roughness {self.roughness:.3f}, "
            f"metallic {self.metallic:.3f}",
            f"normal ({triple(self.normal, 3)}), seen by {self.seen_by:.0f} training photos",
        ]
        if len(self.frames):
            off = np.abs(self.photos - self.renders).mean()
            said.append(f"in {len(self.frames)} photos: display value, twin's (mean difference {off:.3f})")
        for frame, photo, render in zip(self.frames, self.photos, self.renders, strict=True):
            said.append(f"  frame {frame}: {triple(photo, 3)} | {triple(render, 3)}")
        return said


class Scope:
    """A scope in a fitted twin.

    Attributes:
        pose: float64 [4, 4], camera to world, mm. frame: index of the photo at whose pose it stands, or None.
        knobs: by name; ``turn_knob`` turns them. off: effects that are switched off.
    """

    def __init__(self, twin: Twin):
        self.twin = twin
        self._base = self._renderer = Renderer(twin)
        try:
            self._sequence: Sequence | None = twin.sequence()
        except SequenceError:
            self._sequence = None
        self._path = path_or_flight(twin)
        self.pose = self._path[0] if len(self._path) else np.eye(4)
        self.frame = 0 if self._sequence else None
        self.heldout = set(twin.source.heldout(len(self._sequence))) if self._sequence else set()
        self.usual_mm = self._usual_mm()
        coat = twin.effects.get("coat")
        self.knobs = {
            "intensity": Knob("light x", 0.1, 4.0, 1.0),
            "n": Knob("n", 0.0, 8.0, twin.light.n),
            "q": Knob("q", 0.0, 4.0, twin.light.q),
            "roughness": Knob("roughness x", 0.2, 2.5, 1.0),
            "coat": Knob("coat", 0.0, 20.0, coat.weight if coat else 0.0),
            "exposure": Knob("exposure x", 0.1, 4.0, 1.0),
        }
        self.effects = [name for name in twin.effects if name == "specular" or name not in FREE]
        self.off: set[str] = set()
        self._values = {name: knob.value for name, knob in self.knobs.items()}
        self._shrink = 0
        self.ms = 0.0

    def turn_knob(self, name: str, value: float) -> bool:
        """Set knob ``name`` to ``value``, kept in its range; whether that changes it."""
        knob, before = self.knobs[name], self._values[name]
        self._values[name] = float(np.clip(value, knob.low, knob.high))
        changed = self._values[name] != before
        if changed:
            self._edit()
        return changed

    def switch(self, name: str, on: bool) -> None:
        """Switch effect ``name`` of the twin on or off."""
        if name not in self.effects:
            raise OptionError(f"the twin has no effect {name!r}; it has {', '.join(self.effects) or 'none'}")
        (self.off.discard if on else self.off.add)(name)
        self._edit()

    def move(self, right_mm: float = 0.0, down_mm: float = 0.0, ahead_mm: float = 0.0) -> None:
        """Move along the scope's own axes."""
        self.pose = self.pose.copy()
        self.pose[:3, 3] += self.pose[:3, :3] @ [right_mm, down_mm, ahead_mm]
        self.frame = None

    def turn(self, right: float = 0.0, down: float = 0.0, roll: float = 0.0) -> None:
        """Turn about the scope's own axes, radians."""
        self.pose = self.pose.copy()
        self.pose[:3, :3] = self.pose[:3, :3] @ Rotation.from_rotvec([-down, right, roll]).as_matrix()
        self.frame = None

    def go_to(self, index: int) -> None:
        """Stand at pose ``index`` of the recorded path, counted around."""
        if len(self._path):
            index %= len(self._path)
            self.pose, self.frame = self._path[index], index if self._sequence else None
            self._stood = index

    def step(self, frames: int, heldout: bool = False) -> None:
        """Go on by so many poses of the path, from the one stood at last; or to the next held-out photo."""
        index = getattr(self, "_stood", 0) + frames
        while heldout and self.heldout and index % len(self._path) not in self.heldout:
            index += 1
        self.go_to(index)

    def view(self, quick: bool = False) -> View:
        """What the scope sees: of the twin's size, or, if ``quick``, small enough to be fast."""
        began = time.perf_counter()
        view = self._renderer.through(self._camera(quick)).view(self.pose, exposure=self._gain())
        self.ms = 1e3 * (time.perf_counter() - began)
        if quick:
            slower, faster = self.ms > QUICK_MS, self.ms < QUICK_MS / 3
            self._shrink = int(np.clip(self._shrink + slower - faster, 0, len(SHRINK) - 1))
        return view

    def photo(self) -> np.ndarray | None:
        """The photo at whose pose the scope stands, uint8 [H, W, 3]; None where there is none."""
        return None if self.frame is None else self._sequence.color(self.frame)

    def prices(self) -> dict[str, float]:
        """Milliseconds that each effect adds to a view from here, by name."""
        camera = self._camera(quick=True)
        whole = frame_ms(self._base.through(camera), self.pose)
        found = {}
        for name in self.effects:
            gone = self._base.edited(without(self.twin, {name}))
            found[name] = max(whole - frame_ms(gone.through(camera), self.pose), 0.0)
        return found

    def probe(self, u: float, v: float) -> Probe | None:
        """What is known of the point seen at (u, v), each 0 to 1 across the view; None where none is seen."""
        camera = self.twin.camera
        mask = np.zeros((camera.height, camera.width), bool)
        mask[int(np.clip(v, 0, 0.9999) * camera.height), int(np.clip(u, 0, 0.9999) * camera.width)] = True
        hits = self._base.caster.cast(camera, self.pose, mask)
        if not len(hits):
            return None
        surface, materials = self.twin.surface, self.twin.materials
        point_mm = surface_points(surface, hits)[0]
        normal = hits.interpolate(surface, surface.normals)[0]
        frames, photos, renders = self._in_photos(point_mm)
        return Probe(
            point_mm,
            normal / np.linalg.norm(normal),
            hits.interpolate(surface, materials.base_color)[0],
            float(hits.interpolate(surface, materials.roughness)[0]),
            float(hits.interpolate(surface, materials.metallic)[0]),
            float(hits.interpolate(surface, surface.seen_by.astype(np.float32))[0]),
            float(hits.distance_mm[0]),
            tuple(frames),
            np.reshape(photos, (-1, 3)),
            np.reshape(renders, (-1, 3)),
        )

    def picture(
        self,
        size: tuple[int, int],
        quick: bool = False,
        notes: list[str] | None = None,
        footer: list[str] | None = None,
    ) -> np.ndarray:
        """The scope's view, uint8 [height, width, 3] of ``size`` (width, height), above photo, render and
        error at a recorded pose, or above ``notes``; ``footer`` is at the bottom."""
        width, height = size
        sheet = np.full((height, width, 3), GROUND, np.uint8)
        view = self.view(quick)
        shown = np.uint8(view.color * 255 + 0.5)
        top, left, tall, wide = self.place(size)
        sheet[top : top + tall, left : left + wide] = _resized(shown, wide, tall)
        below, footer = top + tall + LINE_PX, footer or []
        end = height - len(footer) * LINE_PX - MARGIN_PX
        _say(sheet, footer, (MARGIN_PX, end + LINE_PX))
        where = (
            "free"
            if self.frame is None
            else f"frame {self.frame}" + (", held out" if self.frame in self.heldout else "")
        )
        _say(
            sheet, [f"{where}: {view.shape[1]} x {view.shape[0]} in {self.ms:.0f} ms"], (MARGIN_PX, below - 4)
        )
        photo = self.photo()
        if notes:
            _say(sheet[:end], notes, (MARGIN_PX, below + LINE_PX))
        elif photo is not None:
            self._compare(sheet[below + MARGIN_PX : end], photo, view)
        return sheet

    def place(self, size: tuple[int, int]) -> tuple[int, int, int, int]:
        """Top, left, height and width of the view in a picture of ``size``."""
        width, height = size
        camera = self.twin.camera
        room = height * 0.66
        scale = min(width / camera.width, room / camera.height)
        wide, tall = max(int(scale * camera.width), 1), max(int(scale * camera.height), 1)
        return 0, (width - wide) // 2, tall, wide

    def _compare(self, strip: np.ndarray, photo: np.ndarray, view: View) -> None:
        """Draw photo, render and error side by side into ``strip`` [h, W, 3]."""
        render = _resized(np.uint8(view.color * 255 + 0.5), photo.shape[1], photo.shape[0])
        mask = cv2.resize(np.uint8(view.mask), (photo.shape[1], photo.shape[0])) > 0
        heat = error_heat(photo / 255, render / 255, mask & self._sequence.lens_mask)
        scale = min(strip.shape[1] / 3 / photo.shape[1], (strip.shape[0] - LINE_PX) / photo.shape[0])
        if scale * min(photo.shape[:2]) < 8:
            return
        wide, tall = int(scale * photo.shape[1]), int(scale * photo.shape[0])
        for column, (name, image) in enumerate((("photo", photo), ("render", render), ("error", heat))):
            strip[:tall, column * wide : (column + 1) * wide] = _resized(image, wide, tall)
            _say(strip, [name], (column * wide + MARGIN_PX, tall + LINE_PX - 4))

    def _in_photos(self, point_mm: np.ndarray) -> tuple[list[int], list[np.ndarray], list[np.ndarray]]:
        """Frames that see a point, its display values there and the twin's."""
        frames, photos, renders = [], [], []
        if self._sequence is None:
            return frames, photos, renders
        camera, caster = self.twin.camera, self._base.caster
        for index, pose in enumerate(self._path):
            uv = camera.project((point_mm - pose[:3, 3]) @ pose[:3, :3])
            if not np.isfinite(uv).all():
                continue
            column, row = np.rint(uv).astype(int)
            if not (0 <= column < camera.width and 0 <= row < camera.height):
                continue
            if not self._sequence.lens_mask[row, column]:
                continue
            ray = point_mm - pose[:3, 3]
            length = float(np.linalg.norm(ray))
            origin = self.twin.surface.to_local(pose)[None, :3, 3].astype(np.float32)
            clear = caster.unobstructed(
                origin, np.float32(ray / length)[None], np.float32([length * (1 - SHADOW_SHARE)])
            )
            if clear[0]:
                mask = np.zeros((camera.height, camera.width), bool)
                mask[row, column] = True
                frames.append(index)
                photos.append(self._sequence.color(index)[row, column] / 255)
                gain = self._gain_of(index)
                renders.append(self._base.view(pose, mask, gain).color[row, column])
        return frames, photos, renders

    def _edit(self) -> None:
        """Make the renderer that knobs and switches ask for."""
        value, light = self._values, self.twin.light
        kept = self.usual_mm ** (value["q"] - light.q)  # another q keeps the brightness at the usual distance
        twin = without(self.twin, self.off)
        rough = self.twin.materials.roughness
        if value["roughness"] != 1:
            rough = np.clip(rough * np.float32(value["roughness"]), 0, 1)
            twin = replace(twin, materials=replace(twin.materials, roughness=rough))
        effects = twin.effects
        if "coat" not in self.off and value["coat"] != self.knobs["coat"].value:
            shine = self.twin.effects.get("coat") or Coat()
            effects = effects.including(replace(shine, weight=value["coat"]))
        light = replace(light, L0=light.L0 * value["intensity"] * kept, n=value["n"], q=value["q"])
        twin = replace(twin, light=light, effects=effects)
        self._renderer = self._base.edited(twin, value["exposure"])

    def _gain(self) -> float:
        return 1.0 if self.frame is None else self._gain_of(self.frame)

    def _gain_of(self, index: int) -> float:
        gain = self.twin.effects.get("gain")
        return float(gain.of(np.array([index]))[0]) if gain else 1.0

    def _camera(self, quick: bool) -> Camera:
        camera = self.twin.camera
        if not quick:
            return camera
        scale = min(1.0, (QUICK_PX / (camera.width * camera.height)) ** 0.5) * SHRINK[self._shrink]
        return _scaled(camera, scale)

    def _usual_mm(self) -> float:
        seen = self._base.caster.cast(_scaled(self.twin.camera, 0.25), self.pose).distance_mm
        return float(np.median(seen)) if len(seen) else 1.0


def without(twin: Twin, names: set[str]) -> Twin:
    """The twin with effects ``names`` off; shadows go with the guides that cast them."""
    gone = names | ({"shadows"} if "offset" in names else set())
    if "specular" in gone:
        twin = replace(twin, materials=replace(twin.materials, f0=0.0))
    return replace(twin, effects=twin.effects.without(gone))


@lru_cache(maxsize=8)
def _scaled(camera: Camera, scale: float) -> Camera:
    return camera if scale == 1 else camera.scaled(scale)


def _resized(image: np.ndarray, width: int, height: int) -> np.ndarray:
    shrinks = width < image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _say(image: np.ndarray, lines: list[str], corner: tuple[int, int]) -> None:
    """Write ``lines`` into ``image``, as many as it has room for."""
    for number, line in enumerate(lines):
        at = (corner[0], corner[1] + number * LINE_PX)
        if at[1] < image.shape[0]:
            cv2.putText(image, line, at, cv2.FONT_HERSHEY_SIMPLEX, FONT, INK, 1, cv2.LINE_AA)

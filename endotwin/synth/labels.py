"""The labels of a frame: only those that were asked for are computed."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from endotwin.effects.exposure import following
from endotwin.effects.video import Clip
from endotwin.errors import OptionError
from endotwin.light.incidence import to_camera
from endotwin.render import Renderer, View
from endotwin.run.streams import Stream
from endotwin.surface import Surface
from endotwin.surface.vectors import shifted
from endotwin.synth.job import Job
from endotwin.synth.photograph import photographed
from endotwin.synth.sight import Sights
from endotwin.twin.fluids import covered
from endotwin.twin.polyps import numbered

MASK_NONE, MASK_FILLED, MASK_UNSEEN, MASK_VALID = 0, 64, 128, 255
HIDDEN_NONE, HIDDEN_NO, HIDDEN_YES = 128, 0, 255

LABELS: dict[str, tuple[str, ...]] = {
    "rgb": ("rgb",),
    "rgb_linear": ("rgb_linear",),
    "rgb_exr": ("rgb_exr",),
    "depth": ("depth",),
    "depth_exr": ("depth_exr",),
    "normals": ("normals",),
    "mask": ("mask",),
    "albedo": ("albedo",),
    "roughness": ("roughness",),
    "metallic": ("metallic",),
    "diffuse": ("diffuse",),
    "specular": ("specular", "highlights"),
    "flow": ("flow", "flow_hidden"),
    "flow_forward": ("flow_forward", "flow_forward_hidden"),
    "flow_exr": ("flow_exr", "flow_hidden"),
    "flow_forward_exr": ("flow_forward_exr", "flow_forward_hidden"),
    "flow_npz": ("flow_npz", "flow_hidden"),
    "flow_forward_npz": ("flow_forward_npz", "flow_forward_hidden"),
    "occlusion": ("occlusion",),
    "triangles": ("triangles",),
    "polyp": ("polyp",),
    "fluid": ("fluid",),
    "overlay": ("overlay",),
    "scene_flow": ("scene_flow",),
    "scene_flow_forward": ("scene_flow_forward",),
    "vertices": ("vertices",),
}
"""Labels that may be asked for, and the images that each one is written as."""

OF_MOTION = ("scene_flow", "scene_flow_forward", "vertices")
"""Labels that only tissue which moves by itself has."""

OF_POLYPS = ("polyp",)
"""Labels that only a twin with polyps has."""

OF_FLUIDS = ("fluid",)
"""Labels that only a twin with fluids has."""

DEFAULT_LABELS = ("rgb", "depth", "normals", "mask")

MIRRORS = ("coat", "film", "sparkle")
"""Effects that reflect without scattering."""

COLUMNS = {"base_color": slice(0, 3), "roughness": 3, "metallic": 4}
"""Of a view's material."""

HIGHLIGHT = 0.1
"""Display values by which specular reflection brightens a pixel of a highlight, in its darkest channel."""

PHOTOS = {"rgb", "rgb_linear", "rgb_exr"}
SPLIT = {"diffuse", "specular"}
SHADED = PHOTOS | SPLIT | {"albedo", "roughness", "metallic", "overlay"}
"""Labels that need a photo, those of its parts, and all that need the frame's draw."""


def parse_labels(
    text: str, moving: bool = False, polyps: bool = False, fluids: bool = False
) -> tuple[str, ...]:
    """Names of labels from ``rgb,depth,…`` or ``all``, in their own order; raises OptionError.

    ``all`` is those of tissue that is ``moving`` by itself, or is not, and has ``polyps`` and ``fluids``, or
    has none.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if names == ["all"]:
        parts = ((moving, OF_MOTION), (polyps, OF_POLYPS), (fluids, OF_FLUIDS))
        missing = {name for there, names in parts if not there for name in names}
        return tuple(name for name in LABELS if name not in missing)
    unknown = [name for name in names if name not in LABELS]
    if unknown or not names:
        raise OptionError(
            f"there is no label {(unknown or [text])[0]!r}; choose from {', '.join(LABELS)}, or 'all'"
        )
    return tuple(name for name in LABELS if name in names)


def triangle_kinds(surface: Surface) -> np.ndarray:
    """Uint8 [F]: MASK_VALID where every corner was measured and seen by a training photo, MASK_UNSEEN where
    one was seen by none, MASK_FILLED where one was not even measured."""
    filled = surface.filled[surface.triangles].any(axis=1)
    unseen = (surface.seen_by == 0)[surface.triangles].any(axis=1)
    kind = np.where(unseen, np.uint8(MASK_UNSEEN), np.uint8(MASK_VALID))
    return np.where(filled, np.uint8(MASK_FILLED), kind)


class Labeller:
    """Labels the frames of a job; keeps what the latest ones see, and the renderer of the latest draw."""

    def __init__(self, job: Job):
        self._job = job
        self._sights = Sights(job.twin.surface, job.motion, job.trajectory, job.camera)
        self._kinds = triangle_kinds(job.twin.surface)
        twin, count = job.twin, len(job.twin.surface.triangles)
        self._things = {
            "polyp": numbered((each.triangles for each in twin.polyps), count),
            "fluid": covered((each.triangles for each in twin.fluids), count),
        }
        self._T_world_next = following(job.trajectory.T_world_camera, job.trajectory.originals)
        self._shaded: tuple[object, Renderer, Renderer | None] | None = None

    def frame(self, index: int, clip: Clip | None = None) -> dict[str, np.ndarray]:
        """The images of frame ``index`` by name, as ``LABELS`` has them; ``clip``: that its photo is the next
        picture of."""
        job = self._job
        T_world_camera = job.trajectory.T_world_camera[index]
        images, view = {}, None
        renderer = specular_free = None
        if SHADED & set(job.labels):
            renderer, specular_free = self.renderers(index)
        if (PHOTOS | {"specular"}) & set(job.labels):
            view = renderer.view(T_world_camera, hits=self._sights[index].hits)
        if PHOTOS & set(job.labels):
            generator = Stream.SENSOR.generator(job.document["seed"], int(job.trajectory.originals[index]))
            color, radiance = photographed(
                renderer, view, T_world_camera, self._T_world_next[index], generator, clip
            )
            images = {"rgb": color, "rgb_linear": radiance, "rgb_exr": radiance}
        if specular_free is not None:
            matt = specular_free.view(T_world_camera, like=view, hits=self._sights[index].hits)
            images["diffuse"] = matt.color
            if "specular" in job.labels:
                images["specular"] = view.color - matt.color
                red, green, blue = np.moveaxis(images["specular"] > HIGHLIGHT, 2, 0)
                images["highlights"] = np.uint8(255) * (red & green & blue)
            view = view or matt
        geometry = _Geometry(job, self._sights, index, self._kinds, self._things, renderer, view)
        for name in job.images:
            if name not in images:
                images[name] = getattr(geometry, name)
        return {name: images[name] for name in job.images}

    def renderers(self, index: int) -> tuple[Renderer, Renderer | None]:
        """The renderer of the frame's draw, and the one without specular reflection if that is asked for."""
        draw = self._job.draws[index]
        kept = self._shaded
        if kept is None or kept[0] != draw:
            twin, exposure = draw.edited(self._job.twin, self._job.regions)
            if kept is None:
                renderer = Renderer(twin, self._job.camera, caster=self._sights.at_rest, exposure=exposure)
            else:
                renderer = kept[1].edited(twin, exposure)
            specular_free = None
            if SPLIT & set(self._job.labels):
                matt = replace(twin.materials, f0=0.0)
                matt = replace(twin, materials=matt, effects=twin.effects.without(MIRRORS))
                specular_free = renderer.edited(matt, exposure)
            kept = self._shaded = (draw, renderer, specular_free)
        renderers = kept[1:]
        if self._sights.move:
            caster = self._sights[index].caster
            renderers = tuple(renderer and renderer.moved(caster) for renderer in renderers)
        if self._job.gains is None:
            return renderers
        return tuple(renderer and renderer.brighter(self._job.gains[index]) for renderer in renderers)


class _Geometry:
    """The labels of one frame that need no light; each is computed when it is read."""

    def __init__(
        self,
        job: Job,
        sights: Sights,
        index: int,
        kinds: np.ndarray,
        things: dict[str, np.ndarray],
        renderer: Renderer | None,
        view: View | None,
    ):
        self._job, self._sights, self._index = job, sights, index
        self._sight = sights[index]
        self._hits = self._sight.hits
        self._ways: dict[int, np.ndarray] = {}
        self._places: dict[int, np.ndarray] = {}
        self._kinds, self._things, self._renderer, self._view = kinds, things, renderer, view

    def _image(self, values: np.ndarray, empty: float = 0.0) -> np.ndarray:
        shape = (self._job.camera.height, self._job.camera.width)
        return self._hits.laid_out(values, shape, empty)

    def _material(self, name: str) -> np.ndarray:
        if self._view:
            return self._image(self._view.material[:, COLUMNS[name]])
        return self._image(
            self._hits.interpolate(self._job.twin.surface, getattr(self._renderer.twin.materials, name))
        )

    @property
    def depth(self) -> np.ndarray:
        z = self._job.camera.pixel_directions.reshape(-1, 3)[:, 2].take(self._hits.pixel)
        return self._image(self._hits.distance_mm * z, np.nan)

    @property
    def depth_exr(self) -> np.ndarray:
        return self.depth

    @property
    def normals(self) -> np.ndarray:
        if self._view:
            return self._view.normals
        surface = self._sight.surface
        normals = self._hits.interpolate(surface, surface.normals)
        return self._image(to_camera(normals, self._sight.T_world_camera))

    @property
    def albedo(self) -> np.ndarray:
        return self._material("base_color")

    @property
    def roughness(self) -> np.ndarray:
        return self._material("roughness")

    @property
    def metallic(self) -> np.ndarray:
        return self._material("metallic")

    @property
    def mask(self) -> np.ndarray:
        return self._image(self._kinds[self._hits.triangle], MASK_NONE)

    @property
    def triangles(self) -> np.ndarray:
        return self._image(self._hits.triangle, -1)

    @property
    def polyp(self) -> np.ndarray:
        return self._image(self._things["polyp"][self._hits.triangle])

    @property
    def fluid(self) -> np.ndarray:
        return self._image(self._things["fluid"][self._hits.triangle])

    @property
    def overlay(self) -> np.ndarray:
        height, width = self._job.camera.height, self._job.camera.width
        effect = self._renderer.twin.effects.get("overlay")
        hidden = np.zeros((height, width), bool) if effect is None else effect.hides(height, width)
        return np.where(hidden, np.uint8(255), np.uint8(0))

    @property
    def occlusion(self) -> np.ndarray:
        return self._image(np.where(self._sight.hides_surface(), np.uint8(255), np.uint8(0)))

    @cached_property
    def flow(self) -> np.ndarray:
        return self._flow(self._index - 1)

    @cached_property
    def flow_forward(self) -> np.ndarray:
        return self._flow(self._index + 1)

    flow_exr = flow_npz = property(lambda self: self.flow)
    flow_forward_exr = flow_forward_npz = property(lambda self: self.flow_forward)

    @property
    def flow_hidden(self) -> np.ndarray:
        return self._hidden(self._index - 1)

    @property
    def flow_forward_hidden(self) -> np.ndarray:
        return self._hidden(self._index + 1)

    def _towards(self, index: int) -> np.ndarray:
        """From the camera of a frame to where the points of the hits are in it, mm, float32 [N, 3]."""
        if index not in self._ways:
            self._ways[index] = self._sights[index].towards(self._hits)
        return self._ways[index]

    @property
    def scene_flow(self) -> np.ndarray:
        return self._scene_flow(self._index - 1)

    @property
    def scene_flow_forward(self) -> np.ndarray:
        return self._scene_flow(self._index + 1)

    @property
    def vertices(self) -> np.ndarray:
        surface = self._sight.surface
        return shifted(surface.vertices_mm, surface.origin_mm)

    def _scene_flow(self, index: int) -> np.ndarray:
        if not self._exists(index):
            return self._image(np.full((len(self._hits), 3), np.nan, np.float32), np.nan)
        poses = self._job.trajectory.T_world_camera
        ridden_mm = (poses[index] - poses[self._index])[:3, 3].astype(np.float32)
        moved_mm = self._towards(index) - self._towards(self._index)
        return self._image(shifted(moved_mm, ridden_mm), np.nan)

    def _exists(self, index: int) -> bool:
        return 0 <= index < len(self._job.trajectory.T_world_camera)

    @cached_property
    def _uv(self) -> np.ndarray:
        """Pixels of the hits, float64 [N, 2]."""
        v, u = np.divmod(self._hits.pixel, self._job.camera.width)
        return np.stack([u, v], axis=1).astype(np.float64)

    def _uv_at(self, index: int) -> np.ndarray:
        """Where the points of the hits lie in another frame's image, px, float64 [N, 2]."""
        if index not in self._places:
            self._places[index] = self._sights[index].places(self._towards(index))
        return self._places[index]

    def _flow(self, index: int) -> np.ndarray:
        if not self._exists(index):
            return self._image(np.full((len(self._hits), 2), np.nan, np.float32), np.nan)
        return self._image((self._uv_at(index) - self._uv).astype(np.float32), np.nan)

    def _hidden(self, index: int) -> np.ndarray:
        if not self._exists(index):
            return self._image(np.full(len(self._hits), HIDDEN_NONE, np.uint8), HIDDEN_NONE)
        seen = self._sights[index].shows(self._towards(index), self._uv_at(index))
        return self._image(np.where(seen, np.uint8(HIDDEN_NO), np.uint8(HIDDEN_YES)), HIDDEN_NONE)

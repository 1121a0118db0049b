"""The twin: a surface with materials, a light and a camera response, and how it lies on disk."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from endotwin.cameras import Camera, as_camera, camera_from_dict
from endotwin.effects import Decision, Effects
from endotwin.errors import SequenceError, TwinError
from endotwin.light.film import Film
from endotwin.light.shading import F0_DIELECTRIC, respond
from endotwin.run.arguments import as_path
from endotwin.run.jsontext import parsed
from endotwin.run.output import TWIN, write_folder
from endotwin.sequence import Sequence, Split
from endotwin.sequence.readers import open_sequence
from endotwin.surface import Surface
from endotwin.twin import meshes
from endotwin.twin.fluids import Fluid
from endotwin.twin.polyps import Polyp
from endotwin.twin.registration import Registration
from endotwin.twin.soundness import require_sound

if TYPE_CHECKING:
    import open3d
    import pyvista
    import trimesh
    from torch import Tensor

    from endotwin.render import Renderer, View

VERSION = 2
OWN = re.compile(r"twin\.json|effects\.json|(surface|materials)(-[0-9a-f]{16})?\.safetensors")
"""Files of a twin of any version. Arrays lie in files that are named by their own checksum; ``twin.json``
says which of them are the twin's, so that its rename replaces all of them at once."""
PARTS = ("camera", "source", "materials", "light", "response", "record")
UNSEALED = ("source", "record", "seal")
"""Parts of ``twin.json`` that its checksum leaves out: a rendering does not depend on them."""
MAPS = ("base_color", "roughness", "metallic")
FILM = tuple(Film.__dataclass_fields__)
HOLDOUT_EVERY = 8


@dataclass(frozen=True, eq=False)
class Materials:
    """Disney materials of every vertex.

    Attributes:
        base_color: float32 [V, 3], linear RGB in [0, 1]. roughness, metallic: float32 [V] in [0, 1].
        f0: specular reflectance at normal incidence, one for the whole surface.
        diffuse: ``burley`` (Disney's diffuse lobe, with retro-reflection) or ``lambert`` (that of Han & Wu
            2025).
        film: of fluid, where one is known; None: nowhere.
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    f0: float = F0_DIELECTRIC
    diffuse: str = "burley"
    film: Film | None = None

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by the names under which they lie on disk."""
        film = {} if self.film is None else {f"film_{name}": value for name, value in vars(self.film).items()}
        return {**self.per_vertex, **film}

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray], constants: dict[str, float | str]) -> Materials:
        """What has such ``arrays`` and ``constants``."""
        film = {name: arrays.pop(f"film_{name}") for name in FILM if f"film_{name}" in arrays}
        return cls(**arrays, **constants, film=Film(**film) if film else None)

    @property
    def per_vertex(self) -> dict[str, np.ndarray]:
        """The maps by name."""
        return {name: getattr(self, name) for name in MAPS}

    @property
    def constants(self) -> dict[str, float | str]:
        """What is one for the whole surface, by name."""
        return {"f0": self.f0, "diffuse": self.diffuse}


@dataclass(frozen=True)
class Light:
    """A spotlight at the lens, L(x) = L0·cosⁿθ / d^q, d in mm (Han & Wu 2025)."""

    L0: float
    n: float
    q: float


@dataclass(frozen=True)
class Response:
    """The camera response C = x^γ."""

    gamma: float


@dataclass(frozen=True)
class Source:
    """The sequence that a twin was made from, and the protocol that it was made under.

    Attributes:
        path: the sequence, absolute. format: its reader. scale: factor on the image size.
        geometry: ``known`` (every frame's depth was fused) or ``heldout`` (held-out frames gave neither
            depth nor photo).
        holdout_every: every n-th frame, from the first, is held out of the fit.
        frames: of more training frames than these, so many are used, evenly spread; None: all.
        split: the frames that are to be fitted and held out, where the sequence itself says so or some of its
            frames are left out; else every n-th.
        undistort: width and height of the pinhole images that photos were resampled to; None: they were not.
    """

    path: str
    format: str
    scale: float = 1.0
    geometry: str = "known"
    holdout_every: int = HOLDOUT_EVERY
    frames: int | None = None
    split: Split | None = None
    undistort: tuple[int, int] | None = None

    @classmethod
    def from_dict(cls, values: dict) -> Source:
        """The source that ``asdict`` made ``values`` of."""
        split, undistort = values.get("split"), values.get("undistort")
        split = split and Split(**{name: tuple(indices) for name, indices in split.items()})
        return cls(**{**values, "split": split, "undistort": undistort and tuple(undistort)})

    def open(self) -> Sequence:
        """The sequence; raises SequenceError if it has moved or changed its shape."""
        if not Path(self.path).exists():
            raise SequenceError(
                f"{self.path}, from which the twin was made, is gone; put it back, or make the twin again "
                "with 'endotwin fuse'"
            )
        return self.limited(open_sequence(Path(self.path), self.format, self.scale, self.undistort))

    def limited(self, sequence: Sequence) -> Sequence:
        """The sequence, of which the frames that are left out are not looked at."""
        return sequence if self.split is None else replace(sequence, split=self.split)

    def at_scale(self, scale: float) -> Source:
        """The same source, its images ``scale`` times as large as the photos or as they were resampled to."""
        if self.undistort is None:
            return replace(self, scale=scale)
        width, height = (round(scale * size) for size in self.undistort)
        return replace(self, undistort=(width, height))

    def heldout(self, count: int) -> list[int]:
        """Indices of the held-out frames among ``count``; none where that would leave nothing to fit."""
        if self.split is not None:
            return [index for index in self.split.heldout if index < count]
        return list(range(0, count, self.holdout_every)) if count > 1 else []

    def training(self, count: int) -> list[int]:
        """Indices of the frames whose photos may be fitted."""
        training = self._not_held_out(count)
        if self.frames is None or len(training) <= self.frames:
            return training
        return [training[i] for i in np.linspace(0, len(training) - 1, self.frames).round().astype(int)]

    def without(self, left_out: Iterable[int], count: int) -> Source:
        """The same source with the frames ``left_out`` of its ``count`` neither fitted nor held out; of the
        others, those that were held out still are."""
        left_out = set(left_out)
        parts = self._not_held_out(count), self.heldout(count)
        kept = (tuple(index for index in part if index not in left_out) for part in parts)
        return replace(self, split=Split(*kept))

    def _not_held_out(self, count: int) -> list[int]:
        heldout = set(self.heldout(count))
        every = range(count) if self.split is None else self.split.training
        return [index for index in every if index < count and index not in heldout]


@dataclass(frozen=True, eq=False)
class Twin:
    """A surface and, once fitted, its materials, light and response.

    Attributes:
        surface: mesh, normals, coverage.
        camera: the camera model of the sequence (at the scale used).
        source: where the photos are, and the protocol.
        materials, light, response: None until ``fit``.
        record: how the twin was made: options, seconds of each stage, scores.
        effects: what it has beside the paper's light and materials. decisions: why, by name of the effect.
        registration: corrections of the photos' poses; None: they are where the sequence says.
        polyps: that were grown on the surface. fluids: that lie on it.
    """

    surface: Surface
    camera: Camera
    source: Source
    materials: Materials | None = None
    light: Light | None = None
    response: Response | None = None
    record: dict = field(default_factory=dict)
    effects: Effects = field(default_factory=Effects)
    decisions: dict[str, Decision] = field(default_factory=dict)
    registration: Registration | None = None
    polyps: tuple[Polyp, ...] = ()
    fluids: tuple[Fluid, ...] = ()

    @property
    def fitted(self) -> bool:
        return self.materials is not None

    def require_fitted(self) -> None:
        """Raise TwinError unless the twin is fitted."""
        if not self.fitted:
            raise TwinError("the twin has no materials yet; run 'endotwin fit' on it first")

    @property
    def film(self) -> Film | None:
        """The film of fluid that is seen; None without one, or without the effect."""
        return self.materials.film if self.fitted and "film" in self.effects else None

    @property
    def depth_at_photos(self) -> bool:
        """Whether depth maps lie where their photos do: no alignment moved the photos alone."""
        return self.registration is None or self.registration.with_depth

    def displayed(self, radiance: Tensor) -> Tensor:
        """Display values of radiance ≥ 0, of its shape; above 1 where a photo would clip."""
        color = respond(radiance, self.response.gamma)
        return self.effects["tone"].shown(color) if "tone" in self.effects else color

    def untoned(self, photo: np.ndarray) -> np.ndarray:
        """Display values in 0 … 1, of the photo's shape, as they are without a tone curve: x^γ."""
        return self.effects["tone"].undone(photo) if "tone" in self.effects else photo

    def __repr__(self) -> str:
        lines = [repr(self.surface), f"camera: {self.camera.model} {self.camera.width}×{self.camera.height}"]
        if self.fitted:
            light, materials = self.light, self.materials
            lines += [
                f"light: L0 {light.L0:.4g}, n {light.n:.3f}, q {light.q:.3f}: L0·cosⁿθ/d^q, d in mm",
                f"response: γ {self.response.gamma:.4f}",
                f"materials: {materials.diffuse}, roughness {np.median(materials.roughness):.2f}, "
                f"f0 {materials.f0:.3f}",
                f"effects: {', '.join(map(str, self.effects.values())) or 'none'}",
            ]
        else:
            lines.append("not fitted")
        if self.polyps:
            lines.append(
                f"polyps: {', '.join(f'{each.kind} of {each.size_mm:.1f} mm' for each in self.polyps)}"
            )
        if self.fluids:
            lines.append(
                f"fluids: {', '.join(f'{each.kind} over {each.size_mm:.1f} mm' for each in self.fluids)}"
            )
        scores = self.record.get("eval")
        if scores and scores.get("psnr") is not None:
            lines.append(f"held out: {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f}")
        return "Twin(\n  " + "\n  ".join(lines) + "\n)"

    def __getstate__(self) -> dict:
        """What a copy in another process needs: the fields, and not the scene that rays are cast into."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def with_record(self, **entries) -> Twin:
        """The same twin with ``entries`` added to its record."""
        return replace(self, record={**self.record, **entries})

    def at_scale(self, scale: float) -> Twin:
        """The same twin, seen by its camera with images of another factor of the photos' size."""
        source = self.source.at_scale(scale)
        written = source.open().camera
        camera = self.registration.camera(written) if self.registration else written
        return replace(self, source=source, camera=camera)

    def sequence(self) -> Sequence:
        """The sequence that the twin was made from, its photos where they were aligned to; raises
        SequenceError if it is gone or of another size."""
        sequence = self.source.open()
        sizes = [f"{camera.width}×{camera.height}" for camera in (sequence.camera, self.camera)]
        if sizes[0] != sizes[1]:
            raise SequenceError(
                f"{self.source.path} has frames of {sizes[0]} at the twin's scale, but the twin was made "
                f"from {sizes[1]}; make it again with 'endotwin fuse'"
            )
        return sequence if self.registration is None else self.registration.applied(sequence)

    def render(self, T_world_camera: np.ndarray, camera: Camera | None = None) -> View:
        """The view from a pose: what the photo taken there would look like, with its labels.

        Args:
            T_world_camera: [4, 4], camera to world, mm, OpenCV axes.
            camera: to see through; the twin's own unless given.

        Returns:
            A view with the arrays ``color``, ``radiance``, ``depth_mm``, ``normals``, ``albedo``, ``mask``.

        Raises:
            TwinError: the twin is not fitted. TrajectoryError: that is no rigid pose. CameraError: that is no
                camera.
        """
        camera = self.camera if camera is None else as_camera(camera)
        return self._renderer.through(camera).view(T_world_camera)

    @cached_property
    def _renderer(self) -> Renderer:
        from endotwin.render import Renderer

        return Renderer(self)

    def to_trimesh(self) -> trimesh.Trimesh:
        """The mesh in trimesh, with base colour (as displayed), and every map in ``vertex_attributes``."""
        return meshes.to_trimesh(self)

    def to_open3d(self) -> open3d.t.geometry.TriangleMesh:
        """The mesh as a tensor mesh of Open3D, every map in ``mesh.vertex``, [V, 1] or [V, 3]."""
        return meshes.to_open3d(self)

    def to_pyvista(self) -> pyvista.PolyData:
        """The mesh in pyvista, every map in ``point_data``; ``rgb`` is the base colour as displayed."""
        return meshes.to_pyvista(self)

    def export(self, path: Path | str, overwrite: bool = False) -> None:
        """Write the twin for other programs, by the suffix of ``path`` (see ``endotwin.export.FORMATS``)."""
        from endotwin.export import export

        export(self, path, overwrite)

    def show(self, screenshot: Path | None = None) -> None:
        """Open the inspector's window, or write its picture to ``screenshot``."""
        from endotwin.look.inspector import inspect

        inspect(self, screenshot)

    def save(self, path: Path, overwrite: bool = False) -> None:
        """Write the twin folder, whole or not at all.

        Raises:
            OutputError: ``path`` exists and ``overwrite`` is false, or it is something else than a twin.
        """
        arrays = self._arrays()
        document = self._document(arrays)
        contents = {document["files"][part]: content for part, content in arrays.items()}
        contents[TWIN] = (json.dumps(document, indent=1) + "\n").encode()
        write_folder(path, contents, TWIN, OWN, overwrite)

    @property
    def seal(self) -> str:
        """SHA-256 of all that a rendering depends on: equal for the same twin, whatever its record."""
        return self._document(self._arrays())["seal"]

    def _arrays(self) -> dict[str, bytes]:
        """Contents of the files of arrays, by part."""
        fitted = {"materials": save(self.materials.arrays)} if self.fitted else {}
        return {"surface": self.surface.to_bytes(), **fitted}

    def _document(self, arrays: dict[str, bytes]) -> dict:
        """Content of ``twin.json`` beside files of ``arrays``."""
        document = {
            "version": VERSION,
            "files": {part: f"{part}-{_checksum(content)}.safetensors" for part, content in arrays.items()},
            "camera": self.camera.to_dict(),
            "source": asdict(self.source),
            "materials": self.materials.constants if self.fitted else None,
            "light": asdict(self.light) if self.light else None,
            "response": asdict(self.response) if self.response else None,
            "effects": self.effects.to_dict(),
            "decisions": {name: asdict(decision) for name, decision in self.decisions.items()},
            "record": self.record,
        }
        if self.registration is not None:
            document["registration"] = self.registration.to_dict()
        if self.polyps:
            document["polyps"] = [asdict(polyp) for polyp in self.polyps]
        if self.fluids:
            document["fluids"] = [asdict(fluid) for fluid in self.fluids]
        return {**document, "seal": _seal(document)}

    @classmethod
    def load(cls, path: Path) -> Twin:
        """Read a twin folder.

        Raises:
            TwinError: no twin there, a damaged one, or one of a newer version.
        """
        path = as_path("twin", path)
        document = _read_document(path)
        try:
            _check_document(document)
            files = _checked_files(path, document)
            constants = document["materials"]
            twin = cls(
                surface=Surface.load(files["surface"]),
                camera=camera_from_dict(document["camera"], path / TWIN),
                source=Source.from_dict(document["source"]),
                materials=Materials.of(load_file(files["materials"]), constants) if constants else None,
                light=Light(**document["light"]) if document["light"] else None,
                response=Response(**document["response"]) if document["response"] else None,
                record=document["record"],
                effects=Effects.from_dict(document.get("effects", {})),
                decisions=_read_decisions(path, document),
                registration=Registration.from_dict(moved)
                if (moved := document.get("registration"))
                else None,
                polyps=tuple(map(Polyp.from_dict, document.get("polyps", ()))),
                fluids=tuple(map(Fluid.from_dict, document.get("fluids", ()))),
            )
            return require_sound(twin)
        except FileNotFoundError as error:
            if _read_document(path) != document:  # another run replaced the twin just now
                return cls.load(path)
            raise TwinError(
                f"{path} is a damaged twin ({error.filename} is gone); make it again with 'endotwin fuse'"
            ) from error
        except (OSError, KeyError, TypeError, ValueError, AttributeError, SafetensorError) as error:
            what = f"it has no {error}" if isinstance(error, KeyError) else error
            raise TwinError(
                f"{path} is a damaged twin ({what}); make it again with 'endotwin fuse'"
            ) from error


def as_twin(given: Twin | Path | str) -> Twin:
    """``given`` itself, or the twin in the folder that it names. Raises TwinError where it is neither."""
    if isinstance(given, Twin):
        return given
    if isinstance(given, str | os.PathLike):
        return Twin.load(Path(given))
    raise TwinError(f"{type(given).__name__} is no twin; give what fuse_twin or fit_twin made, or its folder")


def _checksum(content: bytes) -> str:
    """The first 64 bits of the SHA-256, in the 16 digits that names of files have."""
    return hashlib.sha256(content).hexdigest()[:16]


def _seal(document: dict) -> str:
    """SHA-256 of all in ``twin.json`` that a rendering depends on."""
    sealed = {part: value for part, value in document.items() if part not in UNSEALED}
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


def _check_document(document: dict) -> None:
    """Raise KeyError where a part is missing, and ValueError where they do not match their checksum."""
    for part in PARTS:
        document[part]
    if document["version"] > 1 and document["seal"] != _seal(document):
        raise ValueError(f"{TWIN} does not match its checksum")


def _checked_files(path: Path, document: dict) -> dict[str, Path]:
    """The twin's array files by part. Raises ValueError where one does not match its checksum."""
    if document["version"] == 1:
        return {part: path / f"{part}.safetensors" for part in ("surface", "materials")}
    files = {}
    for part, name in document["files"].items():
        if name != f"{part}-{_checksum((path / name).read_bytes())}.safetensors":
            raise ValueError(f"{name} does not match its checksum")
        files[part] = path / name
    return files


def _read_decisions(path: Path, document: dict) -> dict[str, Decision]:
    decisions = document.get("decisions", {})
    if document["version"] == 1 and (path / "effects.json").exists():
        decisions = parsed((path / "effects.json").read_text(encoding="utf-8"))["effects"]
    return {name: Decision(**values) for name, values in decisions.items()}


def _read_document(path: Path) -> dict:
    try:
        document = parsed((path / TWIN).read_text(encoding="utf-8"))
        version = document["version"]
    except NotADirectoryError:
        raise TwinError(f"{path} is a file; give the folder of the twin") from None
    except FileNotFoundError:
        name = "TWIN" if path.exists() else path
        raise TwinError(
            f"{path} is not a twin (it has no twin.json); make one with 'endotwin fuse SEQUENCE -o {name}'"
        ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TwinError(
            f"{path / 'twin.json'} cannot be read ({error}); make the twin again with 'endotwin fuse'"
        ) from error
    if not isinstance(version, int):
        raise TwinError(f"{path / 'twin.json'} has no version; make the twin again with 'endotwin fuse'")
    if version > VERSION:
        raise TwinError(
            f"{path} is a twin of version {version}, newer than this endotwin reads (version {VERSION}); "
            "update endotwin"
        )
    return document

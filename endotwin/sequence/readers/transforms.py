"""``transforms.json`` of nerfstudio and instant-ngp, with depth maps.

Unit: positions are metres, as nerfstudio has it, unless the file says ``"unit": "mm"``, times its
``applied_scale`` if it has one, by which depth is not multiplied; depth in that unit is the stored value
times ``depth_unit_scale_factor`` (0.001 unless given: 16-bit millimetres beside positions in metres; 1 for
OpenEXR, as renderers write it), or times instant-ngp's ``integer_depth_scale``.
Depth is z-depth, 0 for none; PNG, TIFF, NPY, NPZ and OpenEXR are read. A frame's depth map is its
``depth_file_path`` (instant-ngp: ``depth_path``), or else ``depth/NAME.*`` beside the photo's folder, or
``NAME_depth.*`` beside the photo. Where a frame's ``mask_path`` is 0, there is no depth. Principal points
count from the image's edge, so half a pixel is subtracted.

A split is heeded: ``train_filenames`` and ``test_filenames`` (or else ``val_filenames``) in the file, or
``transforms_train.json`` and ``transforms_test.json`` (or else ``_val``) in its place. Other frames are
unused.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from math import isfinite, pi, tan
from pathlib import Path

import numpy as np

from endotwin.cameras import Camera, camera_from_dict
from endotwin.errors import CameraError, SequenceError
from endotwin.sequence.floatdepth import SUFFIXES, in_mm
from endotwin.sequence.images import read_color, read_plane
from endotwin.sequence.poses import (
    AXES_OPENGL_OPENCV,
    frame_times,
    read_json,
    read_transforms_poses,
    transforms_pose_unit_mm,
    transforms_unit_mm,
)
from endotwin.sequence.readers.split import Listing, as_lists, joined, of_files, of_lists
from endotwin.sequence.sequence import Sequence

MARK = "transforms.json"
TRAINING, HELD_OUT = "transforms_train.json", ("transforms_test.json", "transforms_val.json")
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tiff", ".tif")
DEPTH_SUFFIXES = (".png", ".tiff", ".tif", *SUFFIXES)
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")
FISHEYE = "OPENCV_FISHEYE"
INTRINSICS = (
    "camera_model",
    "is_fisheye",
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "camera_angle_x",
    "camera_angle_y",
)
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
DEPTH_SCALE = 0.001


def detects(path: Path) -> bool:
    """Whether ``path`` is a JSON file, or a folder with a ``transforms.json`` (or ``_train``)."""
    if path.is_file():
        return path.suffix == ".json"
    return any((path / name).is_file() for name in (MARK, TRAINING))


def read(path: Path) -> Sequence:
    """The sequence of a ``transforms.json`` or of the folder that holds it, at its native size."""
    listings = [_listing(file) for file in files(path)]
    every = joined(listings)
    return Sequence(
        path=path,
        format="transforms",
        camera=_common_camera(listings),
        T_world_camera=every.T_world_camera,
        color_files=tuple(every.color_files),
        depth_files=tuple(every.depth_files),
        read_depth_mm=partial(read_depth_mm, level_mm=every.level_mm, masks=_masks(every)),
        timestamps_s=frame_times(len(every.frames)),
        split=of_lists(every) if len(listings) == 1 else of_files(listings, every),
        camera_file=" and ".join(each.file.name for each in listings),
    )


def write_poses(path: Path, sequence: Sequence) -> None:
    """Write what lists the frames of ``sequence`` again, with its poses; two files as one that lists a
    split."""
    listings = [_listing(file) for file in files(sequence.path)]
    poses = sequence.T_world_camera @ AXES_OPENGL_OPENCV
    poses[:, :3, 3] /= transforms_pose_unit_mm(listings[0].content, listings[0].file)
    pose_of = dict(zip(sequence.color_files, poses.tolist(), strict=True))
    frames = [
        {**frame, "transform_matrix": pose_of[photo]}
        for listing in listings
        for frame, photo in zip(listing.frames, listing.color_files, strict=True)
    ]
    content = {**listings[0].content, "frames": frames}
    if len(listings) > 1:
        content |= as_lists(listings)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def pose_unit_mm(path: Path) -> float:
    """Millimetres in the unit of the positions of ``path``."""
    file = files(path)[0]
    return transforms_pose_unit_mm(read_json(file), file)


def files(path: Path) -> list[Path]:
    """The files that list the frames of ``path``: one, or that to be fitted and that to be scored by."""
    if path.is_file():
        return [path]
    if (path / MARK).is_file():
        return [path / MARK]
    return [path / TRAINING, *[path / name for name in HELD_OUT if (path / name).is_file()][:1]]


def _listing(file: Path) -> Listing:
    content = read_json(file)
    T_world_camera, frames = read_transforms_poses(file)
    if not frames:
        raise SequenceError(f"{file} has no frames; export the file again")
    color_files = [_color_file(file, frame) for frame in frames]
    depth_files = [_depth_file(file, *pair) for pair in zip(frames, color_files, strict=True)]
    level_mm = _depth_scale(file, content, depth_files[0]) * transforms_unit_mm(content, file)
    return Listing(file, content, T_world_camera, frames, color_files, depth_files, level_mm)


def read_depth_mm(path: Path, level_mm: float, masks: Mapping[Path, Path] | None = None) -> np.ndarray:
    """A depth map of any numeric type, float32 [H, W] in mm, ``level_mm`` a level; NaN where it is not
    positive, and where the mask that goes with it is 0."""
    raw = read_plane(path)
    if raw.dtype == np.uint8:
        raise SequenceError(f"{path} holds 8 bit, too coarse for depth; write 16-bit PNG or floating point")
    depth_mm = in_mm(raw, level_mm)
    if masks and path in masks:
        mask = read_plane(masks[path])
        if mask.shape != depth_mm.shape:
            raise SequenceError(f"{masks[path]} is not of the size of {path.name}; give them the same size")
        depth_mm[mask == 0] = np.nan
    return depth_mm


def _color_file(file: Path, frame: dict) -> Path:
    name = frame.get("file_path")
    if not isinstance(name, str):
        raise SequenceError(f"{file} has a frame without 'file_path'; export the file again")
    photo = file.parent / name
    places = [photo, *(photo.with_name(photo.name + suffix) for suffix in COLOR_SUFFIXES)]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise SequenceError(
            f"{photo}, named in {file.name}, does not exist; add the photo or remove its frame"
        )
    return found


def _depth_file(file: Path, frame: dict, photo: Path) -> Path:
    named = frame.get("depth_file_path") or frame.get("depth_path")
    if named:
        depth = file.parent / str(named)
        if not depth.is_file():
            raise SequenceError(
                f"{depth}, named in {file.name}, does not exist; add the depth map or remove its frame"
            )
        return depth
    places = [
        place
        for suffix in DEPTH_SUFFIXES
        for place in (
            file.parent / "depth" / (photo.stem + suffix),
            photo.parent.parent / "depth" / (photo.stem + suffix),
            photo.with_name(photo.stem + "_depth" + suffix),
        )
    ]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise SequenceError(
            f"{photo} has no depth map; add depth/{photo.stem}.png or 'depth_file_path' to {file}"
        )
    return found


def _masks(listing: Listing) -> dict[Path, Path]:
    """Masks that frames name, by the depth map that each limits; nerfstudio leaves out pixels that are 0."""
    file, masks = listing.file, {}
    for frame, depth in zip(listing.frames, listing.depth_files, strict=True):
        if named := frame.get("mask_path"):
            masks[depth] = file.parent / str(named)
            if not masks[depth].is_file():
                raise SequenceError(
                    f"{masks[depth]}, named in {file.name}, does not exist; add the mask or remove its name"
                )
    return masks


def _depth_scale(file: Path, content: dict, depth: Path) -> float:
    usual = 1.0 if depth.suffix.lower() == ".exr" else DEPTH_SCALE
    scale = content.get("depth_unit_scale_factor", content.get("integer_depth_scale", usual))
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < float("inf"):
        raise SequenceError(f"{file}: 'depth_unit_scale_factor' is {scale!r}; set it to a positive number")
    return scale


def _common_camera(listings: list[Listing]) -> Camera:
    """The camera of all files; raises CameraError where they differ in it, or in the scale of their depth."""
    cameras = [_camera(each.file, each.content, each.frames, each.color_files[0]) for each in listings]
    for camera, listing in zip(cameras, listings, strict=True):
        if camera != cameras[0] or listing.level_mm != listings[0].level_mm:
            raise CameraError(
                f"{listing.file} has another camera or depth scale than {listings[0].file.name}; give both "
                "the same"
            )
    return cameras[0]


def _camera(file: Path, content: dict, frames: list[dict], photo: Path) -> Camera:
    """The one camera of all frames, its parameters at the top of the file or, all alike, in every frame."""
    keys = INTRINSICS + DISTORTION
    each = [{key: frame.get(key, content.get(key)) for key in keys} for frame in frames]
    if any(parameters != each[0] for parameters in each):
        raise CameraError(f"{file} has frames of different cameras; split it into a sequence for each camera")
    given = {key: value for key, value in each[0].items() if value is not None}
    for key in keys[2:]:
        value = given.get(key, 1)
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise CameraError(f"{file}: {key!r} is {value!r}; set it to a finite number")
    if "w" not in given or "h" not in given:
        given["h"], given["w"] = read_color(photo).shape[:2]
    return camera_from_dict(_description(file, given), file)


def _description(file: Path, given: dict) -> dict:
    """The content of a ``camera.json`` for the intrinsics that a ``transforms.json`` gives."""
    model = given.get("camera_model", FISHEYE if given.get("is_fisheye") else "OPENCV")
    distortion = {key: given.get(key, 0.0) for key in DISTORTION}
    if model not in (*PINHOLES, FISHEYE):
        known = ", ".join((*PINHOLES, FISHEYE))
        raise CameraError(f"{file}: camera model {model!r} is unknown; set 'camera_model' to one of {known}")
    if model != FISHEYE and given.get("is_fisheye"):
        raise CameraError(f"{file} says 'is_fisheye' and {model!r}; remove one of both")
    if model == FISHEYE:
        distortion = {key: distortion[key] for key in ("k1", "k2", "k3", "k4")}
    elif distortion.pop("k4"):
        raise CameraError(
            f"{file}: 'k4' of a pinhole camera is not supported; undistort the images, or leave it out"
        )
    fl_x = given["fl_x"] if "fl_x" in given else _focal(file, given.get("camera_angle_x"), given["w"])
    fl_y = given["fl_y"] if "fl_y" in given else _focal(file, given.get("camera_angle_y"), given["h"]) or fl_x
    if not fl_x:
        raise CameraError(f"{file} has neither 'fl_x' nor 'camera_angle_x'; add the focal length in pixels")
    return {
        "model": "fisheye" if model == FISHEYE else "pinhole",
        "width": given["w"],
        "height": given["h"],
        "fx": fl_x,
        "fy": fl_y,
        "cx": given.get("cx", given["w"] / 2) - 0.5,
        "cy": given.get("cy", given["h"] / 2) - 0.5,
        **distortion,
    }


def _focal(file: Path, angle: float | None, size: float) -> float | None:
    """Focal length in pixels of a pinhole whose image of ``size`` pixels spans ``angle`` radians."""
    if angle is None:
        return None
    if not 0 < angle < pi:
        raise CameraError(f"{file}: a field of view of {angle:g} radians; give one between 0 and π")
    return size / 2 / tan(angle / 2)

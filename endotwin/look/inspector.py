"""A look at a twin: its maps on the mesh, from outside and inside, and the camera path."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import FrameType

import numpy as np
import pyvista as pv
from vtkmodules.vtkCommonCore import vtkLogger

from endotwin.cameras import Camera
from endotwin.cameras.perspective import height_degrees
from endotwin.errors import EndotwinError, OptionError, TrajectoryError
from endotwin.look.scope import Scope
from endotwin.look.scopepane import PANES, ScopePane
from endotwin.run.arguments import as_path
from endotwin.run.output import check_picture, whole_file
from endotwin.sequence.images import write_png
from endotwin.sequence.poses import read_poses, write_c3vd_poses
from endotwin.synth.trajectories.lumen import Lumen
from endotwin.synth.trajectories.recorded import path_or_flight, recorded_poses
from endotwin.twin import Twin, as_twin

TILE = (720, 540)
"""Size in pixels, width and height, of one view in a contact sheet; a window is twice as large, if it can."""

SCREEN = 0.85
"""Share of the screen that a window takes at most: the rest is for its frame and for panels."""

CLOSER = 1.3
"""How much nearer than VTK would have it the mesh is shown, where it has a window of its own."""

STOPPING, HEED_MS = (signal.SIGINT, signal.SIGTERM), 200

OFF_SCREEN_WINDOWS = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")

SCOPE = "scope"
"""Beside the maps, what a picture can show: the view through the scope."""

KEYS = ("m, space: next map   o: outside   i: inside", "c: camera path   k: save keyframe   q: quit")
FRUSTA = 8
SEAM = 1 / 120
"""Width of the mesh's edges, as seen from inside, in widths of the picture: two pixels of a photo of 240."""
LEAP = 10.0
"""Where a step between poses is this many times the usual one, they are drawn as points and not as a path."""

BACKGROUND, INK, UNSEEN, PATH = "#14161a", "#e8e8e8", "#555b66", "#ffb000"
CAPTION_OPACITY = 0.7
MARGIN_PX = 12
DISPLAY_GAMMA = 2.2
SHADING = {"ambient": 0.7, "diffuse": 0.3, "smooth_shading": True}
BAR = {"color": INK, "vertical": False, "n_labels": 2}
BAR |= {"position_x": 0.5, "position_y": 0.86, "width": 0.47, "height": 0.12, "unconstrained_font_size": True}
BAR |= {"title_font_size": 18, "label_font_size": 16}


@dataclass(frozen=True)
class Map:
    """One attribute of the surface, ready to be shown.

    Attributes:
        title: for the label on screen.
        values: [V], shown through a colour scale, or uint8 [V, 3], shown as RGB.
        limits: of the colour scale; None for RGB.
        number: how a value of the scale is written.
        below: what values under the lower limit are called; None where there are none.
    """

    title: str
    values: np.ndarray
    limits: tuple[float, float] | None = None
    number: str = "%.2f"
    below: str | None = None


def twin_maps(twin: Twin) -> dict[str, Map]:
    """The maps that ``twin`` has, by name: materials only once it is fitted."""
    surface = twin.surface
    maps: dict[str, Map] = {}
    if twin.fitted:
        display = np.clip(twin.materials.base_color, 0, 1) ** (1 / DISPLAY_GAMMA)
        maps["base_color"] = Map("base colour", _rgb(display))
        for name in ("roughness", "metallic"):
            values = getattr(twin.materials, name)
            maps[name] = Map(name, values, _limits(values))
        if twin.materials.film is not None:
            film = twin.materials.film
            wet = film.on_all(film.weight, len(surface.vertices_mm))
            maps["film"] = Map("film of fluid: mirrored light", wet, _limits(wet[wet > 0]))
    most = max(int(surface.seen_by.max(initial=0)), 2)
    maps["coverage"] = Map("coverage: training frames", surface.seen_by, (1, most), "%.0f", "unseen")
    maps["normals"] = Map("normals: x, y, z as red, green, blue", _rgb((surface.normals + 1) / 2))
    return maps


def inspect(
    twin: Twin | Path | str,
    screenshot: Path | str | None = None,
    map: str | None = None,
    overwrite: bool = False,
    keyframes: Path | str = "keyframes.txt",
) -> None:
    """Open a window on ``twin``, or write a contact sheet of its maps without a display.

    The window shows the mesh from outside and, once the twin is fitted, the view through the scope: flown by
    mouse and keys, beside the photos, under any light (``Scope``).

    Args:
        twin: or its folder.
        screenshot: PNG file to write instead of opening a window.
        map: ``base_color``, ``roughness``, ``metallic``, ``film`` (where there is one), ``coverage`` or
            ``normals``: the window's first, the sheet's only one; ``scope``: the window's pane with the view
            through the scope. All maps unless given.
        overwrite: whether ``screenshot`` may exist.
        keyframes: pose file that the key k adds the window's view to, for the trajectory ``spline:FILE``.

    Raises:
        OptionError: the twin has no such map, or there is no display to open a window on.
        OutputError: ``screenshot`` exists or cannot be written.
    """
    twin = as_twin(twin)
    maps = twin_maps(twin)
    named = [*maps, *([SCOPE] if twin.fitted else [])]
    if map is not None and map not in named:
        reason = "" if twin.fitted else " (it is not fitted yet)"
        raise OptionError(f"the twin has no map {map!r}{reason}; choose one of {', '.join(named)}")
    if screenshot is None:
        screen = _screen()
        if screen is None:
            raise OptionError("there is no display to open a window on; name a PNG file as screenshot")
        scope = Scope(twin) if twin.fitted else None
        size = _fitting((2 * TILE[0], 2 * TILE[1]), screen)
        stage = Stage(twin, maps, off_screen=False, tile=size, panes=PANES if scope else None)
        stage.open_window(map if map in maps else next(iter(maps)), Path(keyframes), scope)
        return
    screenshot = as_path("screenshot", screenshot)
    check_picture(screenshot, overwrite)
    if map == SCOPE:
        write_png(screenshot, Scope(twin).picture((TILE[0], 2 * TILE[1])), overwrite)
        return
    sheet = Stage(twin, maps, off_screen=True).contact_sheet([map] if map else list(maps))
    write_png(screenshot, sheet, overwrite)


def _screen() -> tuple[int, int] | None:
    """Width and height of the screen, px; None where no display answers, and VTK has no windows to show."""
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    plotter = pv.Plotter(off_screen=False)
    window = plotter.render_window
    screen = None if window.GetClassName() in OFF_SCREEN_WINDOWS else tuple(window.GetScreenSize())
    plotter.close()
    return screen


@contextmanager
def _stoppable(plotter: pv.Plotter) -> Iterator[None]:
    """A window that is shown in the block closes on SIGINT and SIGTERM, which then are heeded as before it.

    VTK waits for events in C and takes the signals for itself: a timer gives Python its turn, and the
    handlers are set in its first one.
    """
    kept = {number: signal.getsignal(number) for number in STOPPING}
    caught: list[int] = []

    def stop(number: int, _: FrameType | None) -> None:
        caught.append(number)
        plotter.iren.terminate_app()

    def heed(*_) -> None:
        for number, handler in kept.items():
            if callable(handler) and signal.getsignal(number) is not stop:
                signal.signal(number, stop)

    plotter.iren.initialize()
    plotter.iren.interactor.AddObserver("TimerEvent", heed)
    plotter.iren.interactor.CreateRepeatingTimer(HEED_MS)
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
    for number in caught[:1]:
        kept[number](number, None)


def _fitting(size: tuple[int, int], screen: tuple[int, int]) -> tuple[int, int]:
    """``size``, or the largest of its shape that the screen has room for: what it says is at its edges."""
    shrink = min(1.0, *(SCREEN * room / wanted for room, wanted in zip(screen, size, strict=True) if room))
    return round(shrink * size[0]), round(shrink * size[1])


def _rgb(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _limits(values: np.ndarray) -> tuple[float, float]:
    """The range of all but the outermost 1% of ``values``, at least 0.02 wide."""
    low, high = np.percentile(values, [1, 99]) if len(values) else (0.0, 1.0)
    middle, half = (low + high) / 2, max((high - low) / 2, 0.01)
    most = max(1.0, float(high))
    return float(max(middle - half, 0)), float(min(max(middle, half) + half, most))


class Stage:
    """One plotter with the mesh, the camera path and the labels.

    From outside, the wall that turns its back is not drawn: one looks into the tube, as into a doll's house.
    From inside it is, and the mesh's edges are drawn wide: no photo saw behind the rims of folds, which else
    would be lined with cracks.

    Args:
        poses: [N, 4, 4] to draw; those of the twin's sequence unless given. frusta: how many of them to draw.
        tile: size of the picture or the window, width and height. panes: how it is divided; the first is the
            mesh's.
    """

    def __init__(
        self,
        twin: Twin,
        maps: dict[str, Map],
        off_screen: bool,
        poses: np.ndarray | None = None,
        frusta: int = FRUSTA,
        tile: tuple[int, int] | None = None,
        panes: dict | None = None,
    ):
        if off_screen:  # VTK warns of the display that is not needed
            vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
        self._maps, self._camera, self._surface = maps, twin.camera, twin.surface
        self._within = False
        self._poses, self._note = recorded_poses(twin) if poses is None else (poses, "")
        self._frusta, self._inside = frusta, _viewpoint(twin, self._poses)
        self._plotter = pv.Plotter(off_screen=off_screen, window_size=list(tile or TILE), **(panes or {}))
        self._plotter.set_background(BACKGROUND, all_renderers=True)
        self._plotter.enable_anti_aliasing("ssaa")
        surface = twin.surface
        faces = np.column_stack([np.full(len(surface.triangles), 3, np.int32), surface.triangles])
        self._mesh = pv.PolyData(surface.vertices_mm.astype(np.float64) + surface.origin_mm, faces.ravel())
        self._mesh.point_data["normals"] = surface.normals
        self._mesh.point_data.active_normals_name = "normals"
        self._shown = next(iter(maps))
        self._path = self._draw_path(surface_size_mm=float(np.ptp(surface.vertices_mm, axis=0).max()))

    def show_map(self, name: str) -> None:
        """Put map ``name`` on the mesh."""
        self._shown = name
        shown = self._maps[name]
        self._mesh.point_data[name] = shown.values
        for title in list(self._plotter.scalar_bars.keys()):
            self._plotter.remove_scalar_bar(title)
        self._plotter.add_mesh(self._mesh, scalars=name, name="surface", reset_camera=False, **_look(shown))
        seams = self._mesh.extract_feature_edges(
            boundary_edges=True, feature_edges=False, manifold_edges=False, non_manifold_edges=False
        )
        if seams.n_cells:
            width_px = SEAM * self._plotter.window_size[0]
            look = {**_look(shown), "lighting": False, "show_scalar_bar": False, "line_width": width_px}
            self._plotter.add_mesh(seams, scalars=name, name="seams", reset_camera=False, **look)
        self._show_within(self._within)
        for bar in self._plotter.scalar_bars.values():
            bar.DrawBackgroundOn()
            bar.GetBackgroundProperty().SetColor(*pv.Color(BACKGROUND).float_rgb)
            bar.GetBackgroundProperty().SetOpacity(CAPTION_OPACITY)
        self._caption(shown.title, "title", (12, self._plotter.window_size[1] - 36), 12)

    def _caption(self, text: str, name: str, position: tuple[int, int], size: int) -> None:
        """Text on a dark ground, so that it can be read on any map."""
        actor = self._plotter.add_text(text, position=position, font_size=size, color=INK, name=name)
        actor.prop.background_color = BACKGROUND
        actor.prop.background_opacity = CAPTION_OPACITY

    def _show_within(self, within: bool) -> None:
        """Draw the wall as it is seen from ``within``, or from outside."""
        self._within = within
        if "surface" in self._plotter.actors:
            self._plotter.actors["surface"].prop.culling = "none" if within else "back"
        if "seams" in self._plotter.actors:
            self._plotter.actors["seams"].visibility = within

    def look_from_outside(self) -> None:
        """Across the tube's longest extent, with its bend in the picture's plane."""
        points = self._mesh.points
        middle = (points.max(axis=0) + points.min(axis=0)) / 2
        _, _, axes = np.linalg.svd(
            points[:: max(len(points) // 20000, 1)] - points.mean(axis=0), full_matrices=False
        )
        self._show_within(False)
        self._plotter.camera.view_angle = 30.0
        self._plotter.camera_position = [middle + 1000 * axes[2], middle, axes[1]]
        self._show_path(True)
        self._plotter.reset_camera()
        self._plotter.camera.zoom(CLOSER if len(self._plotter.renderers) == 1 else 1.0)

    def look_from_inside(self) -> None:
        """From a pose in the lumen through the height of the twin's camera."""
        pose = self._inside
        if pose is None:
            return
        self._show_within(True)
        self._plotter.camera_position = [pose[:3, 3], pose[:3, 3] + pose[:3, 2], -pose[:3, 1]]
        self._plotter.camera.view_angle = height_degrees(self._camera)
        self._plotter.camera.clipping_range = (0.1, 1000.0)
        self._show_path(False)

    def view_pose(self) -> np.ndarray:
        """The pose [4, 4] of the plotter's view: camera to world, mm, OpenCV axes."""
        camera = self._plotter.camera
        ahead = np.subtract(camera.focal_point, camera.position)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, camera.up)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(ahead, right), ahead, camera.position], axis=1)
        return pose

    def save_keyframe(self, path: Path, pose: np.ndarray | None = None) -> int:
        """Add the view, or ``pose`` [4, 4], to the poses in the file ``path``; the number that it has then.

        Raises:
            TrajectoryError: the file exists and is no pose file, or the view is none from within the lumen.
        """
        poses = (self.view_pose() if pose is None else pose)[None]
        if not self._lumen.outlook(self._camera, poses).inside[0]:
            raise TrajectoryError("the view is not from within the lumen, looking at its wall; press i first")
        if path.exists():
            poses = np.concatenate([read_poses(path)[0], poses])
        with whole_file(path, overwrite=True) as beside:
            write_c3vd_poses(beside, poses)
        return len(poses)

    @cached_property
    def _lumen(self) -> Lumen:
        return Lumen(self._surface)

    def open_window(self, name: str, keyframes: Path, scope: Scope | None = None) -> None:
        """Show the window until it is closed; the key k adds its view, that of the ``scope`` if there is one,
        to the pose file ``keyframes``."""
        plotter, names = self._plotter, list(self._maps)

        def next_map() -> None:
            self.show_map(names[(names.index(self._shown) + 1) % len(names)])
            plotter.render()

        def rendered(action) -> None:
            action()
            plotter.render()

        def say(done: str) -> None:
            self._caption(done, "keyframe", (12, 60), 9)
            plotter.render()

        def keep_view() -> None:
            try:
                done = f"keyframe {self.save_keyframe(keyframes, scope and scope.pose)} saved to {keyframes}"
            except (EndotwinError, OSError) as error:
                done = f"no keyframe saved: {error}"
            say(done)

        plotter.add_key_event("k", keep_view)
        for key in ("m", "space"):
            plotter.add_key_event(key, next_map)
        plotter.add_key_event("o", lambda: rendered(self.look_from_outside))
        plotter.add_key_event("i", lambda: rendered(self.look_from_inside))
        plotter.add_key_event("c", lambda: rendered(lambda: self._show_path(not self._path_visible)))
        self._caption(("   " if scope is None else "\n").join(KEYS), "keys", (12, 12), 9)
        if self._note:
            self._caption(self._note, "note", (12, self._plotter.window_size[1] - 66), 9)
        self.show_map(name)
        self.look_from_outside()
        if scope is not None:
            frustum = _frustum(self._camera, np.eye(4), 0.3 * scope.usual_mm)
            marker = plotter.add_mesh(frustum, color=INK, line_width=3, lighting=False, reset_camera=False)
            ScopePane(plotter, scope, marker, keyframes.absolute().parent, say)
        with _stoppable(plotter):
            plotter.show(title="endotwin")

    def contact_sheet(self, names: list[str], inside: bool = True) -> np.ndarray:
        """Uint8 [H, W, 3]: a column a map, outside above ``inside``, where there is a viewpoint.

        The legend stands beside the view from outside only: that from inside fills its tile.
        """
        looks = [self.look_from_outside]
        if inside and self._inside is not None:
            looks.append(self.look_from_inside)
        if self._note:
            self._caption(self._note, "note", (12, self._plotter.window_size[1] - 66), 9)
        columns = []
        for name in names:
            self.show_map(name)
            tiles = []
            for look in looks:
                look()
                for bar in self._plotter.scalar_bars.values():
                    bar.SetVisibility(look == self.look_from_outside)
                self._plotter.render()
                tiles.append(self._plotter.screenshot(return_img=True))
            columns.append(tiles)
        self._plotter.close()
        outside, *rest = (np.hstack(row) for row in zip(*columns, strict=True))
        return np.vstack([_without_blank_rows(outside), *rest])

    def _draw_path(self, surface_size_mm: float) -> list[pv.Actor]:
        if self._poses is None:
            return []
        actors = []
        steps_mm = np.linalg.norm(np.diff(self._poses[:, :3, 3], axis=0), axis=1)
        if len(self._poses) > 1 and steps_mm.max() > LEAP * max(float(np.median(steps_mm)), 1e-3):
            places = pv.PolyData(self._poses[:, :3, 3])
            actors.append(
                self._plotter.add_mesh(places, color=PATH, point_size=4, lighting=False, reset_camera=False)
            )
        elif len(self._poses) > 1:
            line = pv.lines_from_points(self._poses[:, :3, 3])
            actors.append(
                self._plotter.add_mesh(line, color=PATH, line_width=3, lighting=False, reset_camera=False)
            )
        shown = self._poses[:: max(len(self._poses) // self._frusta, 1)]
        frusta = pv.merge([_frustum(self._camera, pose, 0.05 * surface_size_mm) for pose in shown])
        actors.append(
            self._plotter.add_mesh(frusta, color=PATH, line_width=1.5, lighting=False, reset_camera=False)
        )
        return actors

    @property
    def _path_visible(self) -> bool:
        return any(actor.visibility for actor in self._path)

    def _show_path(self, visible: bool) -> None:
        for actor in self._path:
            actor.visibility = visible


def _without_blank_rows(picture: np.ndarray) -> np.ndarray:
    """The picture [H, W, 3] less the rows that are further than a margin from anything drawn."""
    drawn = (picture != pv.Color(BACKGROUND).int_rgb).any(axis=(1, 2))
    return picture[np.convolve(drawn, np.ones(2 * MARGIN_PX + 1), "same") > 0]


def _look(shown: Map) -> dict:
    """How a map is drawn: colours as they are, numbers by a colour scale, shaded enough to show folds."""
    if shown.limits is None:
        return {"rgb": True, "lighting": False}
    bar = {"title": shown.title, "below_label": shown.below, "fmt": shown.number, **BAR}
    look = {"clim": shown.limits, "cmap": "viridis", "scalar_bar_args": bar, **SHADING}
    return look | ({"below_color": UNSEEN} if shown.below else {})


def _viewpoint(twin: Twin, poses: np.ndarray | None) -> np.ndarray | None:
    """A pose [4, 4] in the lumen: a recorded one, else the first of a flight, else None."""
    if poses is None:
        poses = path_or_flight(twin)
    return poses[len(poses) // 3] if len(poses) else None


def _frustum(camera: Camera, pose: np.ndarray, depth_mm: float) -> pv.PolyData:
    """The pyramid that a perspective camera of the same height sees, as lines, ``depth_mm`` long."""
    half = np.tan(np.radians(height_degrees(camera)) / 2)
    wide = half * camera.width / camera.height
    corners = np.array([[-wide, -half, 1], [wide, -half, 1], [wide, half, 1], [-wide, half, 1]]) * depth_mm
    points = np.vstack([np.zeros(3), corners]) @ pose[:3, :3].T + pose[:3, 3]
    edges = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])
    return pv.PolyData(points, lines=np.column_stack([np.full(8, 2), edges]).ravel())

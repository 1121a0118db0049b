"""The pane of the inspector's window that shows the view through the scope, and what turns it: mouse, keys,
sliders, switches."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyvista as pv

from endotwin.errors import EndotwinError
from endotwin.look.scope import Scope
from endotwin.sequence.images import write_png

PANES = {"shape": (1, 2), "col_weights": [2, 3], "border": False}
"""Mesh at the left, scope at the right."""

HELP = [
    "drag, Left, Right, PgUp, PgDn: turn   wheel, Up, Down: ahead, back   click: what is known of a point",
    "comma, period: previous, next photo   slash: next held out   k: keep pose   x: save picture   y: prices",
]
MOVE = 0.04
"""Of the usual distance: how far a key moves."""

TURN, TURN_PX = 0.06, 0.004
CLICK_PX = 4
REST_S = 0.25
FIRST = 100.0
"""Priority of observers: before those of VTK, which they stop."""

SLIDER = {"interaction_event": "always", "style": "modern", "title_height": 0.016, "color": "#e8e8e8"}
SLIDER |= {"slider_width": 0.018, "tube_width": 0.003, "fmt": "%.2f"}
SWITCH_PX = 18


class ScopePane:
    """Draws ``scope`` into the right pane of ``plotter``, and ``marker`` where it is in the left one.

    Args:
        folder: where pictures are saved. say: shows a message.
    """

    def __init__(
        self, plotter: pv.Plotter, scope: Scope, marker: pv.Actor, folder: Path, say: Callable[[str], None]
    ):
        self._plotter, self._scope, self._marker, self._folder, self._say = (
            plotter,
            scope,
            marker,
            folder,
            say,
        )
        self._notes: list[str] | None = None
        self._drag: tuple[int, int] | None = None
        self._moved_px = 0
        self._moved_at: float | None = None
        self._prices: dict[str, float] = {}
        plotter.subplot(0, 1)
        self._plane = plotter.add_mesh(
            pv.Plane(i_resolution=1, j_resolution=1), texture=pv.Texture(self._picture()), lighting=False
        )
        plotter.view_xy()
        plotter.camera.parallel_projection = True
        self._renderer = plotter.renderer
        plotter.subplot(0, 0)
        self._add_sliders()
        self._add_switches()
        self._keys = self._key_actions()
        self._observe()
        self.draw()

    def draw(self, quick: bool = False) -> None:
        """Draw the view, small if ``quick``; then, once nothing moves any more, whole."""
        picture = self._picture(quick)
        height, width, _ = picture.shape
        self._plane.texture = pv.Texture(picture)
        self._plane.scale = (width / height, 1, 1)
        self._renderer.camera.parallel_scale = 0.5
        self._marker.user_matrix = self._scope.pose
        self._plotter.render()
        self._moved_at = time.monotonic() if quick else None

    def _size(self) -> tuple[int, int]:
        width, height = self._plotter.window_size
        left, _, right, _ = self._plotter.renderers[1].viewport
        return max(int(width * (right - left)), 64), max(height, 64)

    def _picture(self, quick: bool = False) -> np.ndarray:
        return self._scope.picture(self._size(), quick, self._notes, HELP)

    def _moved(self) -> None:
        self._notes = None
        self.draw(quick=True)

    def _add_sliders(self) -> None:
        for place, (name, knob) in enumerate(self._scope.knobs.items()):
            column, row = place % 2, place // 2
            left, height = 0.05 + 0.5 * column, 0.15 + 0.085 * row

            def turned(value: float, name: str = name) -> None:
                if self._scope.turn_knob(name, value):
                    self.draw(quick=True)

            slider = self._plotter.add_slider_widget(
                turned,
                (knob.low, knob.high),
                value=knob.value,
                title=knob.words,
                pointa=(left, height),
                pointb=(left + 0.4, height),
                **SLIDER,
            )
            slider.GetRepresentation().SetLabelHeight(SLIDER["title_height"])
            slider.AddObserver("EndInteractionEvent", lambda *_: self.draw())

    def _add_switches(self) -> None:
        for row, name in enumerate(self._scope.effects):

            def switched(on: bool, name: str = name) -> None:
                self._scope.switch(name, on)
                self.draw()

            look = {"color_on": "#ffb000", "color_off": "#555b66", "background_color": "#14161a"}
            self._plotter.add_checkbox_button_widget(
                switched, value=True, position=self._place(row), size=SWITCH_PX, border_size=2, **look
            )
            self._label(row, name)

    def _label(self, row: int, name: str) -> None:
        price = f": {self._prices[name]:.0f} ms" if name in self._prices else ""
        left, height = self._place(row)
        at = (left + 1.5 * SWITCH_PX, height)
        text = f"{name}{price}"
        self._plotter.add_text(text, position=at, font_size=9, color="#e8e8e8", name=f"effect {name}")

    def _place(self, row: int) -> tuple[float, float]:
        """Where switch ``row`` stands, above the sliders, in px."""
        return 12.0, 0.42 * self._plotter.window_size[1] + 1.5 * SWITCH_PX * row

    def _key_actions(self) -> dict[str, Callable[[], None]]:
        scope, step = self._scope, MOVE * self._scope.usual_mm
        flights = {
            "Up": lambda: scope.move(ahead_mm=step),
            "Down": lambda: scope.move(ahead_mm=-step),
            "Left": lambda: scope.turn(right=-TURN),
            "Right": lambda: scope.turn(right=TURN),
            "Prior": lambda: scope.turn(down=-TURN),
            "Next": lambda: scope.turn(down=TURN),
            "comma": lambda: scope.step(-1),
            "period": lambda: scope.step(1),
            "slash": lambda: scope.step(1, heldout=True),
        }

        def flown(action: Callable[[], None]) -> None:
            action()
            self._moved()

        actions = {key: lambda action=action: flown(action) for key, action in flights.items()}
        return actions | {"x": self._save_picture, "y": self._price}

    def _save_picture(self) -> None:
        number = 1
        while (file := self._folder / f"scope-{number:04d}.png").exists():
            number += 1
        try:
            write_png(file, np.uint8(self._scope.view().color * 255 + 0.5))
            self._say(f"picture saved to {file}")
        except (EndotwinError, OSError) as error:
            self._say(f"no picture saved: {error}")
        self._plotter.render()

    def _price(self) -> None:
        self._prices = self._scope.prices()
        for row, name in enumerate(self._scope.effects):
            self._label(row, name)
        self._plotter.render()

    def _observe(self) -> None:
        """Take the events of the pane before VTK does."""
        interactor = self._plotter.iren.interactor
        for event, heed in {
            "LeftButtonPressEvent": self._press,
            "LeftButtonReleaseEvent": self._release,
            "MouseMoveEvent": self._drag_on,
            "MouseWheelForwardEvent": lambda: self._wheel(1),
            "MouseWheelBackwardEvent": lambda: self._wheel(-1),
            "KeyPressEvent": self._press_key,
            "TimerEvent": self._rest,
        }.items():
            tags: list[int] = []

            def heeded(*_, heed: Callable[[], bool] = heed, tags: list[int] = tags) -> None:
                if heed():
                    interactor.GetCommand(tags[0]).SetAbortFlag(1)

            tags.append(interactor.AddObserver(event, heeded, FIRST))

    def _within(self) -> bool:
        """Whether the mouse is over the pane."""
        x, _ = self._plotter.iren.interactor.GetEventPosition()
        return x >= self._plotter.window_size[0] - self._size()[0]

    def _press(self) -> bool:
        if not self._within():
            return False
        self._drag, self._moved_px = self._plotter.iren.interactor.GetEventPosition(), 0
        return True

    def _drag_on(self) -> bool:
        if self._drag is None:
            return False
        x, y = self._plotter.iren.interactor.GetEventPosition()
        right, up = x - self._drag[0], y - self._drag[1]
        self._moved_px += abs(right) + abs(up)
        if self._moved_px >= CLICK_PX:
            self._scope.turn(right=-TURN_PX * right, down=TURN_PX * up)
            self._drag = (x, y)
            self._moved()
        return True

    def _release(self) -> bool:
        if self._drag is None:
            return False
        if self._moved_px < CLICK_PX:
            self._probe(*self._drag)
        self._drag = None
        return True

    def _probe(self, x: int, y: int) -> None:
        width, height = self._size()
        top, left, tall, wide = self._scope.place((width, height))
        u = (x - (self._plotter.window_size[0] - width) - left) / wide
        v = (height - 1 - y - top) / tall
        if 0 <= u < 1 and 0 <= v < 1:
            probe = self._scope.probe(u, v)
            self._notes = probe.lines() if probe else ["no surface there"]
            self.draw()

    def _wheel(self, steps: int) -> bool:
        if not self._within():
            return False
        self._scope.move(ahead_mm=steps * MOVE * self._scope.usual_mm)
        self._moved()
        return True

    def _press_key(self) -> bool:
        action = self._keys.get(self._plotter.iren.interactor.GetKeySym())
        if action:
            action()
        return action is not None

    def _rest(self) -> bool:
        """Draw the whole view once nothing has moved for a while; called by the window's timer."""
        if self._moved_at is not None and self._drag is None and time.monotonic() - self._moved_at > REST_S:
            self.draw()
        return False

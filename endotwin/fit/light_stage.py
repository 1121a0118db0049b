"""The light's stage: light, response and f0 beside coarse materials.

In turns with the materials, light is found by what varies within vertices (``within``). Where it bounces, it
depends on the materials, so that both are found in one step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from endotwin.effects import Decision, Effects, unjudged
from endotwin.effects.coat import Coat
from endotwin.effects.tone import Tone
from endotwin.evidence.coat import Highlights, best_coat
from endotwin.evidence.coat import judged as judged_coat
from endotwin.evidence.tone import LEAST_CONTRAST, Hues, steadied
from endotwin.evidence.tone import judged as judged_tone
from endotwin.fit import vignetting
from endotwin.fit.lighting import Relighting
from endotwin.fit.model import Globals, at_pixels
from endotwin.fit.state import State, as_bright, too_dark
from endotwin.fit.steps import WORSE, solver_of, started, stepped
from endotwin.fit.within import Renewed, Within
from endotwin.pixels.length_unit import unit_mm
from endotwin.pixels.pace import Pace
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import Start
from endotwin.surface import Surface

CELL_MM = 1.6
"""Finest cells of the features beside which light and response are found, in units of the scene."""

STEPS, BOUNCE_STEPS = 6, 12
"""Steps at most, and those where light bounces, beside those of a new coat's trial."""

HOLD_STEPS = 3
"""In which n and γ stay, and how strongly light bounces is found; found with them, f0 sets out too high."""

COAT_STEP, NEAR, LATEST = 2, 0.1, 8
"""A coat that nobody asked for, and a tone curve, are judged when light and materials are near: after so many
steps; or, where light bounces, after one by which the cost fell by a smaller share, or at the latest."""

JUDGED = ("coat", "tone")
"""Effects that this stage alone judges."""

BOUNCE_HELD = ("q", "L0")
"""Where light bounces, q stays where the fit starts, at the inverse square of a small light: what the bounce
off a mesh errs by would bend it, and γ with it. L0 is told by the albedo's scale."""

MOVES, AT_REST = 3, 2e-3
"""Guides are moved so often, unless they come to rest: within this share of the median viewing distance."""

LEAVING = 2
"""Steps in which light learns to do without what is faint, before the materials do."""

UNCACHED = 3.0
"""So many times longer takes a weight of a table that no cache holds than one of this stage's, in solving."""

CONVERGED, STEADY = 2e-4, 2e-3
"""A step that changes the cost by a smaller share than this is the last; and so is one of light that bounces
that changes γ, n, q and the coat by smaller ones: a tenth of what photos tell of them."""


@dataclass(frozen=True)
class Cost:
    """What the stage took, from which to tell what the detail's will.

    Attributes:
        setup_s, step_s: seconds of the operator and the solver, and of a step without the light.
        solve_s: those of the step that do not depend on its pixels.
        weights: hash weights of its points. pixels: samples that it went through.
    """

    setup_s: float
    step_s: float
    solve_s: float
    weights: int
    pixels: int

    @property
    def sums_s(self) -> float:
        """Seconds of a step that went through the samples."""
        return self.step_s - self.solve_s

    def least_s(self, weights: int) -> float:
        """Seconds of setting up, and of a step without pixels, with so many ``weights``."""
        return self.setup_s * weights / self.weights + self._solving_s(weights)

    def detail_s(self, weights: int, pixels: int, steps: int) -> float:
        """Seconds of so many ``steps`` with more weights and pixels; rather too many, since some of what a
        step does with pixels takes no longer with more."""
        again_s = (steps - 1) * self._solving_s(weights)
        return self.least_s(weights) + again_s + steps * self.sums_s * pixels / self.pixels

    def _solving_s(self, weights: int) -> float:
        return UNCACHED * self.solve_s * weights / self.weights


Toned = tuple[Tone, Decision]


@dataclass(frozen=True)
class FoundLight:
    """The state, and whether there are a coat and a tone curve; ``toned``: a new curve, beside which effects,
    light and materials are to be found again."""

    state: State
    decisions: dict[str, Decision]
    toned: Toned | None


@dataclass(frozen=True)
class Best:
    """A ``state``, with the ``effects`` that were found with it, that costs least under its own light, by the
    ``noise`` at which others are held to it."""

    state: State
    effects: Effects
    cost: float
    noise: float


class LightStage:
    """One search for light, response, f0 and coarse materials.

    Args:
        samples: that tell the light, under it. clipped: those that only say 'at least', not lit, to which a
            coat is held, too.
        wanted: auto, on or off, of coat, tone and vignetting. before: what was found before without the tone
            curve that this found. Where light bounces the search goes on from there, and where time is short
            the coat is judged at once.

    Attributes:
        cost: what its first step took.
    """

    def __init__(
        self,
        samples: Samples,
        clipped: Samples,
        surface: Surface,
        start: Start,
        pace: Pace,
        relighting: Relighting,
        wanted: Mapping[str, str],
        device: torch.device,
        before: FoundLight | None,
    ):
        self._clipped, self._surface, self._pace, self._wanted = clipped, surface, pace, wanted
        self._relighting, self._undetermined = relighting, start.undetermined
        self._bare: Best | None = None
        tone, decision = (None, None) if before is None else before.toned
        self._decisions = {name: unjudged(wanted[name]) for name in JUDGED if wanted[name] == "off"}
        if tone is not None:
            self._decisions["tone"] = decision
        self._unit_mm = unit_mm(surface)
        self._moves = MOVES if relighting.effects.guides_mm else 0
        self._goes_on = before is not None and before.state.shared.bounces and relighting.bounces
        began = pace.stopwatch.total
        options = {"out_of_time": pace.light_is_over, "device": device}
        self._solver, operator = solver_of(samples, surface, self._unit_mm, CELL_MM, **options)
        set_up = pace.stopwatch.total
        if self._goes_on:
            shared = before.state.shared.under(tone).behind(relighting.effects.get("vignetting"))
            self._state = replace(before.state, operator=operator, shared=shared)
        else:
            self._state = started(operator, start, relighting, self._solver.pattern.told, tone)
        relighting(self._solver, self._state)
        ready = pace.stopwatch.total
        self._step(joint=False)
        step_s = pace.stopwatch.total - ready
        weights = operator.forward_csr.shape[0] * len(operator.cells_mm)
        self.cost = Cost(set_up - began, step_s, self._solver.solve_s, weights, len(samples))

    def found(self) -> FoundLight:
        """What is found; where that is a tone curve, as soon as it is."""
        toned = self._in_one_step() if self._relighting.bounces else None
        if toned is None and self._newly_vignetted():
            toned = self._in_one_step()
        if not self._relighting.bounces:
            toned = self._in_turns()
        decisions = {name: unjudged(self._wanted[name]) for name in JUDGED} | self._decisions
        return FoundLight(self._state, decisions, toned)

    def _in_turns(self) -> Toned | None:
        """Light by what varies within vertices, then the materials, then light again."""
        number = 0
        while number < STEPS:
            late = self._late
            if late and number:
                break
            ready = number >= COAT_STEP
            if ready and (toned := self._newly_toned()) is not None:
                return toned
            if ready and self._took_tone_back():
                number = 0
            shared = self._move_guides(self._judged(ready))
            self._renew(shared, self._undetermined, self._noise)
            if late:
                break
            gain = self._step(joint=False)
            done = self._changed_by_less(gain, CONVERGED) and not self._moves
            number = self._next(number, STEPS, COAT_STEP, done)
        self._without_faint()
        return None

    def _in_one_step(self) -> Toned | None:
        """Light and materials in one step, for the strength of the bounce. Ends early where photos show no
        bounce. Coat and tone are judged beside a response that is held near that of displays, for which they
        could pass; then photos are believed as far as the model explains them, by one step at least."""
        number, near, best = 0, self._goes_on and self._pace.hurried, None
        while number < BOUNCE_STEPS and not self._late:
            if near and (toned := self._newly_bent()) is not None:
                return toned
            if near and self._took_tone_back():
                number, near, best = 0, False, None
            shared = self._judged(near)
            holding = number < HOLD_STEPS and not self._goes_on
            held = ("n", "gamma", "k2", "contrast") if holding else self._undetermined
            self._solver.held = (*held, *BOUNCE_HELD)
            on_trial, believed = self._bare is not None, best is not None
            gain = self._step_coated(shared) if shared.coat else self._step(joint=True)
            if self._bare is not None and not on_trial:
                number = min(number, BOUNCE_STEPS - LATEST)
            if too_dark(self._state) and self._bare is not None:
                self._leave_coat("beside it no light would bounce")
            elif too_dark(self._state):
                self._state = self._relighting.without_bounce(self._solver, self._state)
                return None
            tried = self._bare is not None and self._changed_by_less(gain, NEAR)
            if tried:
                self._leave_worse_coat()
            if near and self._bare is None:
                self._solver.learn_error(self._state)
                best = self._better(best)
                self._state = replace(self._state, shared=self._move_guides(self._state.shared))
            if tried:
                self._choose_lobe()
            steady = self._changed_by_less(gain, CONVERGED) or _steady(shared, self._state.shared)
            number = self._next(number, BOUNCE_STEPS, number + 1, steady and believed and not self._moves)
            near = near or number >= LATEST or (self._changed_by_less(gain, NEAR) and not holding)
        self._leave_worse_coat()
        if best is not None:
            self._take_best(self._better(best))
        return None

    def _newly_bent(self) -> Toned | None:
        """As ``_newly_toned``, bent by all pixels, unless time is short: then what comes after bends it."""
        toned = self._newly_toned()
        return toned if toned is None or self._pace.hurried else self._bent(toned)

    def _bent(self, toned: Toned) -> Toned | None:
        """A tone curve that hues tell of, as all pixels bend it in steps with light and materials until these
        are near: what hues say beside what was found without it, that has made up for in part. None where it
        then is next to none; all is as it was."""
        before = self._better(None)
        self._state = replace(self._state, shared=self._state.shared.under(toned[0]))
        for _ in range(BOUNCE_STEPS):
            if self._late or self._changed_by_less(self._step(joint=True), NEAR):
                break
        tone = self._state.shared.tone
        if not self._called_off(tone):
            return tone, toned[1]
        self._take_best(before)
        return None

    def _changed_by_less(self, gain: float, share: float) -> bool:
        """Whether a step by which the cost fell by ``gain`` changed it by less than that share of it."""
        return abs(gain) < share * self._solver.cost(self._state, self._noise)

    def _without_faint(self) -> None:
        """The light that predicts best without what is too faint to be an effect, if there is any; γ stays as
        it was found beside it, if the photos show it."""
        solver, relighting, held = self._solver, self._relighting, self._undetermined
        if not relighting.faint.found:
            return
        if relighting.faint.shows(solver.samples, self._state.shared.gamma):
            held = (*held, "gamma")
        relighting.expose(solver, relighting.effects)
        for _ in range(LEAVING):
            if self._pace.light_is_over():
                return
            self._renew(self._state.shared, held, self._noise)
        if not self._late:
            self._step(joint=False)

    def _renew(self, shared: Globals, held: tuple[str, ...], noise: float) -> None:
        """Light and response, from ``shared``, and what may vary with them, by what varies within vertices.
        Where no endoscope has what would be faint, nothing is."""
        relighting = self._relighting
        within, material = self._within()
        found = within.renewed(material, shared, held, noise, relighting.varied)
        if len(found.faint) and not relighting.faint.with_more(found.faint).possible:
            relighting.expose(self._solver, relighting.effects)
            self._renew(shared, held, noise)
            return
        relighting.vary(self._solver, found)
        self._take(found)

    def _move_guides(self, shared: Globals) -> Globals:
        """Move the guides, unless they are at rest, to where, shadows included, they explain best what varies
        within vertices: the probe that had found them knew of no coat, and less of the bounce. Light and
        response beside that."""
        if not self._moves or self._late:
            return shared
        relighting, held = self._relighting, self._undetermined
        if relighting.bounces:
            held = (*held, *BOUNCE_HELD, "albedo scale")
        within, material = self._within()
        found = within.moved(material, shared, held, self._noise, relighting.moving)
        if np.abs(found.aside_mm).max() < AT_REST * within.samples.distance_mm:
            self._moves = 0
            return shared
        self._moves -= 1
        relighting.move_guides(self._solver, found.aside_mm, self._state)
        return found.shared

    @property
    def _late(self) -> bool:
        return self._pace.light_left <= 2 * self.cost.step_s

    @property
    def _noise(self) -> float:
        """That is left of the photos."""
        return self._solver.noise(self._state)

    def _within(self) -> tuple[Within, torch.Tensor]:
        """The pixels by vertex, and their materials."""
        samples, triangles = self._solver.samples, self._solver.triangles
        material = at_pixels(samples, triangles, self._state.materials)
        return Within.of(samples, self._surface, self._unit_mm), material

    def _take(self, found: Renewed) -> None:
        mean = self._state.mean + torch.tensor([0.0, 0.0, 0.0, found.roughness])
        self._state = replace(self._state, shared=found.shared, mean=mean)

    def _take_best(self, best: Best) -> None:
        self._state = best.state
        self._relighting.expose(self._solver, best.effects)
        self._relighting(self._solver, self._state)

    def _next(self, number: int, steps: int, coat_step: int, done: bool) -> int:
        """The number of the step that follows this one; when all is ``done``, that of the coat, or none."""
        self._pace.report("find the light", number + 1, steps)
        if not done:
            return number + 1
        return steps if self._decisions.keys() >= set(JUDGED) else max(number + 1, coat_step)

    def _newly_vignetted(self) -> bool:
        """Where light bounces, put a lens that vignettes before what is found, if pixels say so and nobody
        has said otherwise; whether it was. Guides, which may have made up for it, move again."""
        relighting = self._relighting
        judged = self._wanted["vignetting"] != "auto" or "vignetting" in relighting.effects
        if judged or "n" in self._undetermined or self._late or not relighting.bounces:
            return False
        self._solver.held = (*self._undetermined, *BOUNCE_HELD)
        before = self._better(None)
        self._state, decision = vignetting.tried(self._solver, relighting, self._state)
        if decision is None:
            self._take_best(before)
            return False
        self._decisions["vignetting"] = decision
        self._goes_on, self._moves = True, MOVES if relighting.effects.guides_mm else 0
        return True

    def _newly_toned(self) -> Toned | None:
        """A tone curve and why, if it is not judged yet, and there is one."""
        if "tone" in self._decisions:
            return None
        tone, self._decisions["tone"] = judged_tone(self._hues(), self._wanted["tone"])
        return None if tone is None else (tone, self._decisions["tone"])

    def _judged(self, ready: bool) -> Globals:
        """Light and response as they are, with the coat, which is judged when they are ``ready``; one that is
        forced on, at once."""
        if "coat" not in self._decisions and (ready or self._wanted["coat"] == "on"):
            return self._coated()
        return self._state.shared

    def _took_tone_back(self) -> bool:
        """Bend the tone curve, if there is one, to where hues are steadiest, unless all pixels have bent it:
        where light bounces. Where it is next to none it is taken back; whether it was."""
        shared = self._state.shared
        if not shared.toned:
            return False
        tone = shared.tone if self._relighting.bounces else steadied(shared.tone, self._hues())
        taken = self._called_off(tone)
        self._state = replace(self._state, shared=shared.under(None if taken else tone))
        return taken

    def _called_off(self, tone: Tone) -> bool:
        """Call a ``tone`` curve off that nobody asked for, if it is next to none; whether it was."""
        if tone.contrast >= LEAST_CONTRAST or self._wanted["tone"] == "on":
            return False
        said = self._decisions["tone"]
        reason = f"{said.reason}, but light and materials found with it leave {tone.contrast:.2f} of it"
        self._decisions["tone"] = replace(said, state="off", reason=reason)
        return True

    def _hues(self) -> Callable[[Tone], Hues]:
        within, material = self._within()
        return within.hues(material, self._state.shared, self._noise)

    def _coated(self) -> Globals:
        """Light and response with the coat that highlights call for."""
        wanted, tried = self._wanted["coat"], self._relighting.bounces
        layer, self._decisions["coat"] = judged_coat(self._highlights(), wanted, tried)
        return replace(self._state.shared, coat=layer)

    def _choose_lobe(self) -> None:
        """Take the lobe that highlights call for beside what was found with the one that was chosen without a
        coat, if there is one."""
        if self._state.shared.coat is not None and (coat := best_coat(self._highlights())) is not None:
            self._state = replace(self._state, shared=replace(self._state.shared, coat=coat))

    def _highlights(self) -> Callable[[Coat], Highlights]:
        """Highlights, by the coat over them, clipped ones included."""
        solver, state, relighting = self._solver, self._state, self._relighting
        under = relighting.relit(relighting.lit(self._clipped), solver.triangles, state)
        shiny = Samples.joined([solver.samples, under], solver.samples.views)
        material = at_pixels(shiny, solver.triangles, state.materials)
        seen = Within.of(shiny, self._surface, self._unit_mm)
        return seen.highlights(material, state.shared, self._noise)

    def _step(self, joint: bool) -> float:
        """A step, of the materials alone unless it is ``joint``; by how much the cost fell."""
        self._state, fell = stepped(self._solver, self._relighting, self._state, joint)
        return fell

    def _step_coated(self, shared: Globals) -> float:
        """A step of all from ``shared`` with the f0, coat and roughness that all pixels ask for, unless they
        are plainly worse after it; by how much the cost fell in all. A new coat, which highlights alone have
        found, is on trial, until its steps have come near what they go to."""
        before = self._better(None)
        if before.state.shared.coat is None and self._wanted["coat"] != "on":
            self._bare = before
        within, material = self._within()
        self._take(within.shone(material, shared, before.noise))
        if self._bare is before and self._state.shared.coat.weight == 0:
            self._leave_coat("all pixels give it no weight")
            return self._step(joint=True)
        self._state = as_bright(self._state, before.state)
        self._relighting(self._solver, self._state)
        self._step(joint=True)
        after = self._solver.cost(self._state, before.noise)
        if after > WORSE * before.cost and before.state.shared.coat is not None:
            self._take_best(before)
            return self._step(joint=True)
        return before.cost - after

    def _leave_worse_coat(self) -> None:
        """End the trial of a new coat, and leave it off if all pixels are plainly worse than before it."""
        bare = self._bare
        if bare is not None and self._solver.cost(self._state, bare.noise) > WORSE * bare.cost:
            self._leave_coat("beside it all pixels are plainly worse")
        self._bare = None

    def _leave_coat(self, flaw: str) -> None:
        self._take_best(self._bare)
        self._bare, coat = None, self._decisions["coat"]
        self._decisions["coat"] = replace(coat, state="off", reason=f"{coat.reason}, but {flaw}")

    def _better(self, best: Best | None) -> Best:
        """The state, by which the samples are lit, or the ``best`` so far if that costs less."""
        noise = self._noise if best is None else best.noise
        cost = self._solver.cost(self._state, noise)
        if best is not None and best.cost <= cost:
            return best
        return Best(self._state, self._relighting.effects, cost, noise)


def _steady(before: Globals, after: Globals) -> bool:
    """Whether light, response and the coat are hardly other than they were."""
    was, now = (
        np.array([each.gamma, *each.log_light[1:], each.coat.weight if each.coat else 0.0])
        for each in (before, after)
    )
    return bool((abs(now - was) < STEADY * np.maximum(was, STEADY)).all())

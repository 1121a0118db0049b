"""Which of the fitted effects a scene calls for: exact arguments first, then a probe of held-out pixels."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from endotwin.effects import Decision, Effect, Effects
from endotwin.effects.gain import Gain
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.offset import Offset
from endotwin.effects.profile import Profile
from endotwin.effects.shadows import Shadows
from endotwin.effects.specular import Specular
from endotwin.effects.vignetting import Vignetting
from endotwin.evidence.bounce import bounced, cell_mm
from endotwin.evidence.guide_search import MOST_GUIDES, Search, shadow_columns
from endotwin.evidence.probe import Fitted, Hypothesis, Probe, Verdict
from endotwin.light.guides import AT_LENS, COSINE, EXPONENTIAL
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import PRIOR
from endotwin.surface.casting import Caster
from endotwin.twin import Light, Twin

ORDER = ("offset", "interreflection", "gain", "profile", "vignetting")
"""Effects that are tried, each beside those already kept; the strongest first."""

SEARCH_PIXELS = 8_000
"""Guides are sought with so many pixels of the probe, and polished with all."""

MIN_GAIN_BESIDE_BOUNCE_DB = 0.5
"""Bounced light is known by patches only: gain or profile could mend by 0.2 dB what that lacks."""


@dataclass(frozen=True)
class Decided:
    """The model of light that a scene calls for.

    Attributes:
        effects: those that are on, with parameters. decisions: of every fitted effect, by name.
        light: where the fit starts instead of at the closed form, which is right for a light at the lens
            alone; None where that is what it is, L0 = 0 where nothing tells its strength. gamma: the
            response to start with.
    """

    effects: Effects
    decisions: dict[str, Decision]
    light: Light | None
    gamma: float


def decide(samples: Samples, twin: Twin, caster: Caster, wanted: Mapping[str, str]) -> Decided:
    """Decide the effects of the light from ``samples`` that tell it.

    Args:
        wanted: auto, on or off by name of the effect; auto unless given.
    """
    trial = _Trial(Probe(samples, twin, caster), wanted)
    for name in ORDER:
        if trial.wanted(name) == "on":
            trial.adopt(name, None)
    while (best := trial.strongest()) is not None:
        trial.adopt(*best)
    return trial.decided()


class _Trial:
    """Hypotheses about one probe, from the plainest to what it calls for."""

    def __init__(self, probe: Probe, wanted: Mapping[str, str]):
        self._probe, self._wanted = probe, wanted
        self._kept = probe.fit(Hypothesis())
        self._left = [name for name in ORDER if self.wanted(name) == "auto"]
        self._seconds = dict.fromkeys((*ORDER, "shadows"), 0.0)
        self._decisions: dict[str, Decision] = {}
        self._tried_last: dict[str, Verdict] = {}
        self._found: dict[str, Fitted] = {}

    def wanted(self, name: str) -> str:
        return self._wanted.get(name, "auto")

    def strongest(self) -> tuple[str, Verdict] | None:
        """The effect that gains most beside those kept, if any is worth keeping."""
        tried = {name: self._tried(name) for name in self._left if self._possible(name)}
        self._tried_last = tried
        worth = [name for name, verdict in tried.items() if self._worth(name, verdict)]
        name = max(worth, key=lambda name: tried[name].gain_db, default=None)
        return None if name is None else (name, tried[name])

    def _worth(self, name: str, verdict: Verdict) -> bool:
        """Whether to adopt: an offset has to prove itself then, so that a hint is enough."""
        if name == "offset":
            return verdict.hints
        bounced = self._kept.hypothesis.bounced is not None
        return verdict.keep and (not bounced or verdict.gain_db >= MIN_GAIN_BESIDE_BOUNCE_DB)

    def adopt(self, name: str, verdict: Verdict | None) -> None:
        """Keep the effect; of an offset, only if what is found of it predicts better too."""
        if name in self._left:
            self._left.remove(name)
        if name == "offset":
            began = time.perf_counter()
            self._adopt_offset(forced=verdict is None)
            self._seconds[name] += time.perf_counter() - began
        else:
            verdict = verdict or self._tried(name)
            self._kept = self._mixed() if name == "profile" else self._found[name]
            if self._kept.hypothesis.guides_mm != AT_LENS:
                began = time.perf_counter()
                self._kept = self._probe.fit(Search(self._probe, self._kept).polished())
                self._seconds["offset"] += time.perf_counter() - began
            self._decide(name, "on", _reason(verdict, self.wanted(name)), verdict)

    def decided(self) -> Decided:
        """What was kept, and why not the rest."""
        for name in ORDER:
            if name not in self._decisions:
                self._decide(name, "off", self._why_not(name), self._tried_last.get(name))
        if "shadows" not in self._decisions:
            reason = "light at the lens casts no shadow that the lens sees"
            self._decide("shadows", "off", reason, None)
        self._decide_surface()
        decisions = {
            name: replace(decision, fit_s=round(self._seconds.get(name, 0.0), 3))
            for name, decision in self._decisions.items()
        }
        effects, kept = self._effects(), self._kept
        plain = not set(effects) - {"specular"}
        if "interreflection" in effects:
            return Decided(
                effects, decisions, Light(kept.hypothesis.bounced.L0, PRIOR["n"], PRIOR["q"]), PRIOR["gamma"]
            )
        return Decided(effects, decisions, None if plain else Light(0.0, kept.n, kept.q), kept.gamma)

    def _possible(self, name: str) -> bool:
        """Exact arguments: what no photo of this scene could tell."""
        if len(self._probe) == 0:
            return False
        if name == "vignetting":
            return self._kept.hypothesis.guides_mm != AT_LENS
        return name != "gain" or len(self._probe.frames) > 1

    def _why_not(self, name: str) -> str:
        if self.wanted(name) == "off":
            return "forced off"
        if not self._possible(name):
            return {
                "vignetting": "with the light at the lens its profile says the same of every pixel",
                "gain": "a single frame has no other to be brighter than",
            }.get(name, "the photos show too little")
        return f"does not predict held-out pixels better ({self._tried_last[name]})"

    def _tried(self, name: str) -> Verdict:
        began = time.perf_counter()
        base = self._kept
        if name == "offset":
            base = self._vignetted(base.hypothesis)
            other = self._probe.with_columns(base, shadow_columns(self._probe))
        else:
            other = self._probe.fit(self._hypothesis(name))
        self._found[name] = other
        verdict = self._probe.compare(base, other)
        self._seconds[name] += time.perf_counter() - began
        return verdict

    def _vignetted(self, hypothesis: Hypothesis) -> Fitted:
        """The hypothesis with a vignetting beside it: guides are sought so, lest what the lens swallows pass
        for one more."""
        return self._probe.fit(replace(hypothesis, vignetting=self.wanted("vignetting") != "off"))

    def _hypothesis(self, name: str) -> Hypothesis:
        kept = self._kept.hypothesis
        if name == "interreflection":
            return replace(kept, bounced=bounced(self._probe, kept))
        if name == "profile":
            return replace(kept, profile=EXPONENTIAL)
        return replace(kept, **{name: True})

    def _mixed(self) -> Fitted:
        """Beside what was kept, the profile at the foot of the parabola through the losses of three."""
        kept = self._kept.hypothesis
        profiles = (COSINE, (COSINE + EXPONENTIAL) / 2, EXPONENTIAL)
        losses = [self._probe.loss(replace(kept, profile=p), self._kept) for p in profiles]
        bend, slope, _ = np.polyfit(profiles, losses, 2)
        foot = -slope / (2 * bend) if bend > 0 else profiles[int(np.argmin(losses))]
        return self._probe.fit(replace(kept, profile=float(np.clip(foot, COSINE, EXPONENTIAL))))

    def _adopt_offset(self, forced: bool) -> None:
        hypothesis = self._kept.hypothesis
        probe, base, best = self._probe, self._vignetted(hypothesis), None
        search = Search(Probe(probe.samples, probe.twin, probe.caster, SEARCH_PIXELS), base)
        found = None
        for number in range(1, MOST_GUIDES + 1):
            found = probe.fit(search.best(found and found.hypothesis))
            if (best is None and forced and number == MOST_GUIDES) or probe.compare(best or base, found).keep:
                best = found
        if best is None:
            self._decide("offset", "off", "no position of one to three guides predicts better", None)
            return
        polished = Search(probe, best).polished()
        best = probe.fit(replace(polished, vignetting=hypothesis.vignetting))
        verdict = probe.compare(self._kept, best)
        unshadowed = probe.fit(replace(best.hypothesis, shadows=False))
        shadow = probe.compare(unshadowed, best)
        shadows = self.wanted("shadows") == "on" or (self.wanted("shadows") == "auto" and shadow.keep)
        self._kept = best if shadows else unshadowed
        self._decide("offset", "on", _reason(verdict, self.wanted("offset")), verdict)
        reason = (
            _reason(shadow, self.wanted("shadows")) if shadows else "no shadow that a held-out pixel shows"
        )
        self._decide("shadows", "on" if shadows else "off", reason, shadow)

    def _decide_surface(self) -> None:
        """The published material's lobe, which no probe of diffuse pixels could tell."""
        on = self.wanted("specular") != "off"
        reason = "part of the published material; its strength f0 is fitted" if on else "forced off"
        self._decide("specular", "on" if on else "off", reason, None)

    def _decide(self, name: str, state: str, reason: str, verdict: Verdict | None) -> None:
        gain_db = None if verdict is None else round(verdict.gain_db, 3)
        self._decisions[name] = Decision(state, reason, gain_db)

    def _effects(self) -> Effects:
        kept, probe = self._kept, self._probe
        effects: list[Effect] = [Specular()] if self.wanted("specular") != "off" else []
        if kept.hypothesis.guides_mm != AT_LENS:
            effects.append(Offset(kept.hypothesis.guides_mm))
        if kept.hypothesis.shadows:
            effects.append(Shadows())
        if kept.hypothesis.bounced is not None:
            effects.append(Interreflection(cell_mm(probe.samples.log_distance.numpy())))
        if self._decisions["profile"].state == "on":
            effects.append(Profile(kept.hypothesis.profile))
        if kept.hypothesis.gain:
            log_gain = kept.log_gain - kept.log_gain.mean()
            effects.append(Gain(tuple(map(int, probe.frames)), tuple(map(float, log_gain))))
        if kept.hypothesis.vignetting:
            k2, k4 = kept.effects.coefficients[3:] / kept.gamma
            effects.append(Vignetting(float(k2), float(k4)))
        return Effects(effects)


def _reason(verdict: Verdict, wanted: str) -> str:
    forced = "forced on; " if wanted == "on" else ""
    return f"{forced}predicts held-out pixels better by {verdict}"

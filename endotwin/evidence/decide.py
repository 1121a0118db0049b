"""Which of the fitted effects a scene calls for: sets of effects, compared on pixels that chose none of their
coefficients.

One effect can pass for another: a gain of each frame swallows most of a bounce that is left out, a vignetting
a guide. So where the light stands, whether it bounces and whether the camera's gain changes are decided
together: of all combinations the one that predicts best, less what is not worth its place beside the rest.
Profile and vignetting, which say little and nearly the same, follow beside what was kept. Only a bounce
turns hues: where these tell of one, there is no set without it, and where they rule it out, none with it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import combinations

import numpy as np

from endotwin.effects import Decision, Effect, Effects
from endotwin.effects.gain import Gain
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.noise import LEVEL
from endotwin.effects.offset import Offset
from endotwin.effects.profile import Profile
from endotwin.effects.shadows import Shadows
from endotwin.effects.specular import Specular
from endotwin.effects.vignetting import Vignetting
from endotwin.evidence.bounce import Patches, Surroundings
from endotwin.evidence.glints import Glints
from endotwin.evidence.guide_search import Ground, Guides, Search, found_guides, polished, settled
from endotwin.evidence.log_light import Bounced
from endotwin.evidence.probe import Fitted, Hypothesis, Probe
from endotwin.evidence.tint import Tints
from endotwin.evidence.verdict import MIN_GAIN_DB, MIN_IMPOSSIBLE_DB, MIN_SIGMAS, Verdict
from endotwin.evidence.worth import BARE, DOUBT, LEAST, more_usual, worth
from endotwin.light.guides import AT_LENS, COSINE, EXPONENTIAL
from endotwin.pixels.casts import Casts
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import PRIOR
from endotwin.surface.casting import Caster
from endotwin.twin import Twin

TOGETHER = ("offset", "interreflection", "gain")
BESIDE = ("profile", "vignetting")

RULED_OUT_SIGMAS = 5.0
"""By which hues have to be steadier without a little of a bounce than with it for there to be none: where
there is none they are by 5.5 to 16, and where there is one less steady by 11 to 28."""

SHOWN_GAIN = LEVEL / PRIOR["gamma"]
"""Standard deviation of ln gain that changes white by one of 255 levels: a smaller one no photo shows."""


@dataclass(frozen=True)
class Decided:
    """The model of light that a scene calls for.

    Attributes:
        effects: those that are on, with parameters. decisions: of every fitted effect, by name.
        start: n, q and γ from which the fit starts instead of the closed form, which is right for a light at
            the lens alone; None where that is what it is.
        casts: of photos of another white balance than the rest, without which all is decided; None: there
            are none.
    """

    effects: Effects
    decisions: dict[str, Decision]
    start: tuple[float, float, float] | None
    casts: Casts | None = None


def decide(
    samples: Samples,
    twin: Twin,
    caster: Caster,
    glints: Callable[[], Glints],
    wanted: Mapping[str, str],
    late: Callable[[], bool] = lambda: False,
    near_mm: Guides = AT_LENS,
) -> Decided:
    """Decide the effects of the light from ``samples`` that tell it.

    Args:
        glints: those of the photos, looked for where guides are sought.
        wanted: auto, on or off by name of the effect; auto unless given.
        late: whether guides are not to be sought a second time.
        near_mm: guides near which others are looked for first; the lens: none.
    """

    def trial_of(probe: Probe) -> _Trial:
        return _Trial(probe, patches, glints, wanted, late, near_mm)

    probe = Probe(samples, twin, caster)
    patches = cache(partial(Patches, probe))
    trial = trial_of(probe)
    casts = trial.casts()
    if casts is not None:
        trial = trial_of(Probe(casts.taken_off(samples), twin, caster))
    kept = trial.together()
    kept = trial.shadowed(kept)
    for name in trial.stronger_first(kept):
        kept = trial.beside(name, kept)
    return replace(trial.decided(trial.polished(trial.without_idle_gain(kept))), casts=casts)


class _Trial:
    """Sets of effects about one probe, and what was decided of each effect."""

    def __init__(
        self,
        probe: Probe,
        patches: Callable[[], Patches],
        glints: Callable[[], Glints],
        wanted: Mapping[str, str],
        late: Callable[[], bool],
        near_mm: Guides,
    ):
        self._probe, self._patches, self._glints = probe, patches, glints
        self._wanted, self._late, self._near_mm = wanted, late, near_mm
        self._decisions: dict[str, Decision] = {}
        self._seconds = dict.fromkeys((*TOGETHER, *BESIDE), 0.0)
        self._model, self._bouncing = cache(self._fitted), cache(self._bounced)
        self._with, self._gain_is_plain = cache(self._fitted_with), cache(self._no_erring_bounce)
        self._guides_mm = {False: AT_LENS, True: AT_LENS}

    def wanted(self, name: str) -> str:
        """As was asked for; what hues rule out is off."""
        wanted = self._wanted.get(name, "auto")
        return "off" if wanted == "auto" and name == "interreflection" and self._ruled_out else wanted

    def together(self) -> Fitted:
        """What remains of the best set of the effects that are decided together, each beside a vignetting
        that there may be: it would hide guides, or pass for a bounce and a gain."""
        lens = self._sets(("interreflection", "gain"))
        best = self._best(lens)
        if self.wanted("offset") != "off" and len(self._probe):
            began = time.perf_counter()
            self._seek_guides(best)
            self._seconds["offset"] += time.perf_counter() - began
        sets = self._sets(TOGETHER) if self._beside_lens else lens
        if self._beside_lens and self._told_by_glints:
            sets = [names for names in sets if "offset" in names]
        kept, verdicts = self._pruned(self._best(sets))
        for name in TOGETHER:
            self._say(name, name in kept, verdicts.get(name) or self._beside_kept(name, kept))
        return self._probe.fit(replace(self._model(kept).hypothesis, vignetting=False))

    @property
    def _told_by_hues(self) -> bool:
        return self._asks_hues and self._tints.bounced.worth(LEAST)

    @property
    def _ruled_out(self) -> bool:
        return self._asks_hues and self._tints.still.sigmas >= RULED_OUT_SIGMAS

    @property
    def _asks_hues(self) -> bool:
        return self._wanted.get("interreflection", "auto") == "auto" and len(self._probe) > 0

    @cached_property
    def _tints(self) -> Tints:
        """Hues, which guides hardly change, so that they are asked before those are sought."""
        began = time.perf_counter()
        model = self._probe.fit(Hypothesis(gain=self._tellable("gain", None)))
        tints = Tints(self._probe, model, self._surroundings.log_colors(model.hypothesis))
        self._seconds["interreflection"] += time.perf_counter() - began
        return tints

    def casts(self) -> Casts | None:
        """Photos of another white balance than the rest."""
        return self._tints.casts() if len(self._probe) else None

    def _open(self, name: str) -> bool:
        """Whether brightness is to decide on an effect: nobody asked for it or forbade it, nor hues told."""
        return self.wanted(name) == "auto" and not (name == "interreflection" and self._told_by_hues)

    def _seek_guides(self, best: frozenset[str]) -> None:
        """Find the guides without and with bounced light, or with it alone if it is certain, if there are any
        beside the ``best`` set without them; at last beside the bounce of their own light.

        A gain that is not worth its place would explain what guides throw, and hide where they are. Where
        bounced light is left out, a guide near the lens throws into the shadows what nothing else does, and
        those farther out may not show.
        """
        best, _ = self._pruned(best, ("gain",))
        base = self._model(best).hypothesis
        bounces = base.bounced is not None
        found_mm = other_mm = self._found_guides(base, self.wanted("offset") == "on")
        none = bounces and found_mm == AT_LENS
        if self._open("interreflection") and not none and not self._late():
            other = replace(base, bounced=None if bounces else self._bouncing(AT_LENS))
            other_mm = self._found_guides(other, False)
        self._guides_mm = {bounces: _first(found_mm, other_mm), not bounces: _first(other_mm, found_mm)}
        if not self._beside_lens or self.wanted("interreflection") == "off" or self._late():
            return
        own = Hypothesis(self._guides_mm[True], shadows=True, gain=base.gain)
        own = replace(own, bounced=self._bouncing(own.guides_mm))
        self._guides_mm[True] = Search(self._ground.part, own).polished()

    def _found_guides(self, base: Hypothesis, forced: bool) -> Guides:
        return found_guides(self._ground, base, forced, self._near_mm)

    @cached_property
    def _ground(self) -> Ground:
        return Ground(self._probe, self._glints())

    @property
    def _beside_lens(self) -> bool:
        return self._guides_mm[False] != AT_LENS

    @property
    def _told_by_glints(self) -> bool:
        return any(self._ground.glints.tell(guides_mm) for guides_mm in self._guides_mm.values())

    def shadowed(self, kept: Fitted) -> Fitted:
        """``kept``, whose guides cast shadows, or the same without them where too few pixels lie in one, or
        the probe's plainly contradict it: few tell, and that guides beside the lens cast shadows is certain.
        """
        if kept.hypothesis.guides_mm == AT_LENS:
            reason = "light at the lens casts no shadow that the lens sees"
            self._decisions["shadows"] = Decision("off", reason)
            return kept
        unshadowed, verdict = self._ground.unshadowed(kept)
        cast = self._probe.shaded_db(kept) >= MIN_GAIN_DB and verdict.sigmas > -MIN_SIGMAS
        on = self.wanted("shadows") == "on" or (self.wanted("shadows") == "auto" and cast)
        self._say("shadows", on, verdict)
        return kept if on else unshadowed

    def stronger_first(self, kept: Fitted) -> list[str]:
        """Profile and vignetting, first the one that explains more beside ``kept``: they say nearly the same,
        and either would take the other's place."""

        def gain_db(name: str) -> float:
            began = time.perf_counter()
            verdict = self._verdict_beside(name, kept, self._with(name, kept))
            self._seconds[name] += time.perf_counter() - began
            return verdict.gain_db if verdict.possible else -math.inf

        tried = [name for name in BESIDE if self._tried(name, kept)]
        return sorted(BESIDE, key=gain_db, reverse=True) if tried == list(BESIDE) else list(BESIDE)

    def beside(self, name: str, kept: Fitted) -> Fitted:
        """``kept`` with profile or vignetting beside it, if that is worth it where the guides of each predict
        best: guides that were found without it may have made up for it."""
        if not self._tried(name, kept):
            self._say(name, False, None)
            return kept
        began = time.perf_counter()
        other, forced = self._with(name, kept), self.wanted(name) == "on"
        verdict = self._verdict_beside(name, kept, other)
        if (forced or verdict.worth(DOUBT)) and other.hypothesis.guides_mm != AT_LENS:
            kept, other = settled(self._ground, kept), settled(self._ground, other)
            verdict = self._verdict_beside(name, kept, other)
        on = forced or worth(name, verdict, other)
        self._say(name, on, verdict)
        self._seconds[name] += time.perf_counter() - began
        return other if on else kept

    def _tried(self, name: str, kept: Fitted | None) -> bool:
        return self.wanted(name) != "off" and self._tellable(name, kept)

    def _fitted_with(self, name: str, kept: Fitted) -> Fitted:
        """``kept`` with profile or vignetting beside it."""
        if name == "profile":
            return self._profiled(kept)
        return self._probe.fit(replace(kept.hypothesis, vignetting=True))

    def _profiled(self, kept: Fitted) -> Fitted:
        """``kept`` with a profile: where its guides are, or where they move beside an exponential one, which
        guides that were found without it may have made up for."""
        here = self._probe.fit(self._mixed(kept))
        if kept.hypothesis.guides_mm == AT_LENS:
            return here
        moved = settled(self._ground, self._probe.fit(replace(kept.hypothesis, profile=EXPONENTIAL)))
        moved = self._probe.fit(self._mixed(moved))
        return self._probe.better(here, moved)

    def _verdict_beside(self, name: str, kept: Fitted, other: Fitted) -> Verdict:
        """On ``other``, which has the effect ``name`` as well. No endoscope's lens brightens the rim."""
        verdict = self._probe.compare(kept, other)
        brightens = name == "vignetting" and other.vignetting > 0
        return replace(verdict, possible=verdict.possible and not brightens)

    def without_idle_gain(self, kept: Fitted) -> Fitted:
        """``kept``, or the same without a gain that had stood for what was found beside it since."""
        idle = kept.hypothesis.gain and float(kept.log_gain.std()) < SHOWN_GAIN
        if not idle or self.wanted("gain") == "on":
            return kept
        without = self._probe.fit(replace(kept.hypothesis, gain=False))
        self._say("gain", False, self._probe.compare(without, kept))
        return without

    def polished(self, kept: Fitted) -> Fitted:
        """``kept`` with its guides where their shadows in all pixels say that they are."""
        if not kept.hypothesis.shadows or kept.hypothesis.guides_mm == AT_LENS or self._late():
            return kept
        began = time.perf_counter()
        found = polished(self._ground, kept)
        self._seconds["offset"] += time.perf_counter() - began
        return found

    def decided(self, kept: Fitted) -> Decided:
        """The effects of ``kept``, each with the evidence for it or against it."""
        on = self.wanted("specular") != "off"
        reason = "part of the published material; its strength f0 is fitted" if on else "forced off"
        self._decisions["specular"] = Decision("on" if on else "off", reason)
        decisions = {
            name: replace(decision, fit_s=round(self._seconds.get(name, 0.0), 3))
            for name, decision in self._decisions.items()
        }
        effects = self._effects(kept)
        if "interreflection" in effects:
            return Decided(effects, decisions, (kept.start[0], PRIOR["q"], PRIOR["gamma"]))
        plain = not set(effects) - {"specular"}
        return Decided(effects, decisions, None if plain else kept.start)

    def _sets(self, names: Iterable[str]) -> list[frozenset[str]]:
        """All sets of the effects ``names`` that are wanted and can be told, in which those that are forced
        are on, and bounced light that hues tell of."""
        told = [name for name in names if self.wanted(name) != "off" and self._tellable(name, None)]
        free = [name for name in told if self._open(name)]
        certain = frozenset(told).difference(free)
        return [certain.union(some) for count in range(len(free) + 1) for some in combinations(free, count)]

    def _fitted(self, names: frozenset[str]) -> Fitted:
        began = time.perf_counter()
        hypothesis = Hypothesis(gain="gain" in names, vignetting=self.wanted("vignetting") != "off")
        if "offset" in names:
            guides_mm = self._guides_mm["interreflection" in names]
            hypothesis = replace(hypothesis, guides_mm=guides_mm, shadows=True)
        if "interreflection" in names:
            hypothesis = replace(hypothesis, bounced=self._bouncing(hypothesis.guides_mm))
        found = self._probe.fit(hypothesis)
        for name in names:
            self._seconds[name] += (time.perf_counter() - began) / len(names)
        return found

    def _bounced(self, guides_mm: Guides) -> Bounced:
        hypothesis = Hypothesis(guides_mm=guides_mm, shadows=guides_mm != AT_LENS)
        return self._surroundings.bounced(replace(hypothesis, gain=self.wanted("gain") != "off"))

    @cached_property
    def _surroundings(self) -> Surroundings:
        return Surroundings(self._probe, self._patches())

    def _best(self, sets: list[frozenset[str]]) -> frozenset[str]:
        """The set that predicts held-out pixels best, with bounced light where they do not tell, but light
        and response do; what no endoscope has counts MIN_IMPOSSIBLE_DB less."""
        plain = self._model(sets[0])

        def score_db(names: frozenset[str]) -> float:
            model = self._model(names)
            gain_db = self._probe.compare(plain, model).gain_db
            return gain_db if model.possible else gain_db - MIN_IMPOSSIBLE_DB

        best = max(sets, key=score_db)
        bounced = best | {"interreflection"}
        likelier = bounced in sets and more_usual(self._verdict(best, bounced))
        return bounced if likelier else best

    def _pruned(
        self, names: frozenset[str], free: tuple[str, ...] = TOGETHER
    ) -> tuple[frozenset[str], dict[str, Verdict]]:
        """``names`` less those of ``free`` that are not worth their place, the least worth first; and the
        verdicts on those of ``free`` that are."""
        while True:
            judged = names.intersection(free)
            verdicts = {name: self._verdict(names - {name}, names) for name in judged}
            unworthy = [name for name in judged if self._open(name)]
            unworthy = [name for name in unworthy if not self._worth_within(names, name, verdicts[name])]
            if not unworthy:
                return names, verdicts
            names = names - {min(unworthy, key=lambda name: verdicts[name].gain_db)}

    def _worth_within(self, names: frozenset[str], name: str, verdict: Verdict) -> bool:
        model = self._model(names)
        if name == "offset":
            return self._ground.borne_out(model, verdict) or self._ground.certain(model, verdict)
        return worth(name, verdict, model) and (name != "gain" or self._gain_is_plain(names))

    def _no_erring_bounce(self, names: frozenset[str]) -> bool:
        """Whether the gain among ``names`` explains more than bounced light that errs, as that from a mesh of
        what was seen does, by less where less of a pixel's light is bounced: more than one of another
        strength in each frame, or plainly more than all that changes along the path, which no bounce's error
        does from one frame to the next."""
        without = self._model(names - {"gain"}).hypothesis
        if without.bounced is None:
            return True
        uneven = self._probe.fit(replace(without, uneven=True))
        if self._probe.compare(uneven, self._model(names)).sigmas >= MIN_SIGMAS:
            return True
        adrift, flickering = (self._probe.fit(replace(without, adrift=True, gain=on)) for on in (False, True))
        return self._probe.compare(adrift, flickering).keep

    def _verdict(self, without: frozenset[str], names: frozenset[str]) -> Verdict:
        return self._probe.compare(self._model(without), self._model(names))

    def _beside_kept(self, name: str, kept: frozenset[str]) -> Verdict | None:
        """What an effect that is off would gain; None where that was not tried."""
        if not self._tried(name, None) or (name == "offset" and not self._beside_lens):
            return None
        return self._verdict(kept, kept | {name})

    def _tellable(self, name: str, kept: Fitted | None) -> bool:
        """Exact arguments: what the photos of this scene could tell at all."""
        if len(self._probe) == 0:
            return False
        if name == "vignetting":
            model = kept.hypothesis
            return model.guides_mm != AT_LENS or model.bounced is not None
        return name != "gain" or len(self._probe.frames) > 1

    def _mixed(self, kept: Fitted) -> Hypothesis:
        """Beside ``kept``, the profile at the foot of the parabola through the losses of three."""
        profiles = (COSINE, (COSINE + EXPONENTIAL) / 2, EXPONENTIAL)
        designs = [self._probe.linearised(replace(kept.hypothesis, profile=p), kept) for p in profiles]
        losses = [float((self._probe.left(each, kept).residuals ** 2).sum()) for each in designs]
        bend, slope, _ = np.polyfit(profiles, losses, 2)
        foot = -slope / (2 * bend) if bend > 0 else profiles[int(np.argmin(losses))]
        return replace(kept.hypothesis, profile=float(np.clip(foot, COSINE, EXPONENTIAL)))

    def _say(self, name: str, on: bool, verdict: Verdict | None) -> None:
        """Note what was decided, and why."""
        gain_db = None if verdict is None else round(verdict.gain_db, 3)
        if name == "interreflection" and self._ruled_out:
            still = self._tints.still
            reason = f"held-out hues are predicted better without the least of it ({still})"
            gain_db = round(-still.gain_db, 3)
        elif self.wanted(name) == "off":
            reason = "forced off"
        elif on:
            forced = "forced on; " if self.wanted(name) == "on" else ""
            reason = f"{forced}predicts held-out pixels better by {verdict}"
            if not forced and name == "offset" and verdict.gain_db < BARE.gain_db:
                reason = (
                    f"glints stand about guides, and no held-out pixels plainly contradict it ({verdict})"
                )
            elif not forced and name == "interreflection" and self._told_by_hues:
                reason = f"predicts held-out hues better by {self._tints.bounced}, and pixels by {verdict}"
            elif not forced and name == "interreflection" and not verdict.worth(LEAST):
                reason = (
                    f"beside it light and response are more usual; held-out pixels hardly tell ({verdict})"
                )
            elif not forced and verdict.gain_db < 0:
                reason = f"certain beside guides, and no held-out pixels plainly contradict it ({verdict})"
        elif verdict is not None and verdict.keep:
            reason = f"bounced light that is a little off would explain as much ({verdict})"
        elif verdict is not None:
            hardly = "hardly predicts" if verdict.gain_db > 0 else "does not predict"
            hues = f"; hues {self._tints.bounced}" if name == "interreflection" and self._asks_hues else ""
            reason = f"{hardly} held-out pixels better ({verdict}{hues})"
        else:
            known = {
                "offset": "no position of one to three guides predicts better",
                "vignetting": "with all light from the lens its profile says the same of every pixel",
                "gain": "a single frame has no other to be brighter than",
            }
            unknown = "the photos show too little"
            reason = known.get(name, unknown) if len(self._probe) else unknown
            if self.wanted(name) == "on":
                reason = f"asked for, but {reason}"
        self._decisions[name] = Decision("on" if on else "off", reason, gain_db)

    def _effects(self, kept: Fitted) -> Effects:
        hypothesis, probe = kept.hypothesis, self._probe
        effects: list[Effect] = [Specular()] if self.wanted("specular") != "off" else []
        if hypothesis.guides_mm != AT_LENS:
            effects.append(Offset(hypothesis.guides_mm))
        if hypothesis.shadows:
            effects.append(Shadows())
        if hypothesis.bounced is not None:
            effects.append(Interreflection(self._patches().cell_mm))
        if self._decisions["profile"].state == "on":
            effects.append(Profile(hypothesis.profile))
        if hypothesis.gain:
            effects.append(Gain.centred(probe.frames, kept.log_gain))
        if hypothesis.vignetting:
            effects.append(Vignetting(k2=kept.vignetting))
        return Effects(effects)


def _first(*guides_mm: Guides) -> Guides:
    """The first that is not at the lens, if any."""
    return next((each for each in guides_mm if each != AT_LENS), AT_LENS)

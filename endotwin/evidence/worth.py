"""What an effect of the light has to gain to be worth its place.

For most that is what a verdict asks to ``keep`` it. An effect that is not there gains, too: it explains some
of what the rest of the model errs by, which is more where light bounces.
"""

from __future__ import annotations

import math

from endotwin.effects.noise import LEVEL
from endotwin.evidence.probe import Fitted
from endotwin.evidence.verdict import MIN_GAIN_DB, MIN_SIGMAS, Verdict

LEAST = Verdict(0.05, 3.0)
"""What is enough for two effects. Bounced light has no coefficient of its own, so that where there is none it
loses, and where there is it shows most where light grazes and pixels count least. Exponent and profile of the
light say nearly the same as vignetting, and wrongly on it is fitted to none."""

BARE, BARE_HINT = Verdict(0.05, 5.0), Verdict(0.025, 2.0)
"""What guides have to gain where no light bounces, and what is worth a search: the rest of the model is right
to a percent there, and where the light is at the lens guides gain nothing. A bounce errs by more, for which
they make up."""

ANOTHER = Verdict(BARE_HINT.gain_db, BARE.sigmas)
"""What one guide more has to gain beside those that are found: what says that there are any need not say it
once more. Of seventeen random scenes none gained more than 3.2 sigmas by one too many."""

DOUBT = Verdict(0.0, 1.0)
"""What guides have to gain, and their shadows alone, or an effect beside guides, for a closer look at where
these are."""

UNSHADED = Verdict(0.5, MIN_SIGMAS)
"""What guides beside bounced light have to gain where their shadows do not show: on two random scenes with
light at the lens they had gained 0.24 and 0.29 dB, on two with guides 0.9 and 8."""

ROUNDING = LEVEL / math.sqrt(12)
"""What rounding to 8 bits does to ln of white, root mean square. Vignetting that explains more is worth its
place though poses that are off leave so much of the photos that it is less than LEAST. Of 21 random scenes,
as they are and with poses .1 mm and .06° off, it explained 0.0016 to 0.0059 where the lens vignettes, but for
three on which that hardly shows, and 0.0012 at most where it does not."""

LIKELIER = 2.0
"""Nats by which a bounce has to make light and response likelier where pixels do not tell, such as those of
two standard deviations: a gain of each frame can explain what bounces as well, but with another γ."""


def worth(name: str, verdict: Verdict, model: Fitted) -> bool:
    """Whether the effect ``name`` of ``model`` is worth its place by the ``verdict`` on that beside the same
    without it."""
    bounces = model.hypothesis.bounced is not None
    if name == "vignetting":
        return vignettes(verdict, model.effects.width) or verdict.worth(LEAST)
    if name == "interreflection":
        return verdict.worth(LEAST) or more_usual(verdict)
    if name == "offset" and bounces:
        return verdict.worth(UNSHADED)
    return verdict.keep or (name == "offset" and verdict.worth(BARE))


def worth_another(verdict: Verdict, model: Fitted) -> bool:
    """Whether the guides of ``model`` are worth it by the ``verdict`` on it beside one guide less."""
    return verdict.keep or (model.hypothesis.bounced is None and verdict.worth(ANOTHER))


def vignettes(verdict: Verdict, width: float) -> bool:
    """Whether vignetting explains, by the ``verdict`` on it, more than ROUNDING of what is left, whose
    ``width`` is in ln of display values."""
    explained = width * math.sqrt(max(0.0, 10 ** (verdict.gain_db / 10) - 1))
    return verdict.worth(Verdict(0.0, LEAST.sigmas)) and explained >= ROUNDING


def more_usual(verdict: Verdict) -> bool:
    """Whether light and response say that light bounces, and pixels hardly say anything else."""
    return verdict.likelier >= LIKELIER and verdict.gain_db > -MIN_GAIN_DB


def hints_at_guides(verdict: Verdict, model: Fitted) -> bool:
    """Whether the guides of ``model`` are worth a longer search by the ``verdict`` on it beside none."""
    return verdict.hints if model.hypothesis.bounced is not None else verdict.worth(BARE_HINT)

"""Effect by effect: each is compared with its own absence, beside the evidence of the fit that decided it."""

import json
from dataclasses import asdict

import cv2
import numpy as np
import pytest
import tube_sequence
from hypothesis import given
from hypothesis import strategies as st

from endotwin.effects import FITTED, RENDERED, Decision
from endotwin.errors import OptionError
from endotwin.sequence.readers import open_sequence
from endotwin.tradeoff import effects
from endotwin.tradeoff.by_effect import section, table
from endotwin.tradeoff.plot import _apart, draw_effects

BASE = effects.base("standard")
SCORES = {"psnr": 40.0, "psnr_covered": 41.0, "ssim": 0.97, "lpips": None, "covered": 0.9}


def decided(**states: str) -> dict[str, dict]:
    """Decisions as a result keeps them; all off but those named."""
    return {
        name: {"state": states.get(name, "off"), "reason": f"<{name}>", "gain_db": 0.1, "render_ms": 2.0}
        for name in (*FITTED, *RENDERED)
    }


def keep(folder, rung, found: dict[str, dict], **measured: float) -> None:
    """Write a result of the rung."""
    (folder / "results").mkdir(parents=True, exist_ok=True)
    result = {**SCORES, "seconds": 20.0, "peak_memory_mb": 1000.0, "load": 0.1, "frame_ms": 50.0}
    result |= {"stages": {"gather": 20.0}, "effects": found, **measured, "config": asdict(rung.config)}
    (folder / "results" / f"{rung.name}.0.json").write_text(json.dumps(result))


@pytest.fixture
def rows(tmp_path) -> list[dict]:
    """A scene with gain (1.5 dB, 3 s, 7 ms), without guides, where a coat cannot be had and profile costs."""
    on = decided(specular="on", gain="on")
    on["gain"]["render_ms"] = 7.0
    keep(tmp_path, BASE, on)
    cases = {effects.AS_DECIDED: BASE, **effects.forced(BASE, effects.decisions(BASE, tmp_path))}
    for effect, case in cases.items():
        if effect not in (effects.AS_DECIDED, "coat"):
            keep(tmp_path, case, {**on, effect: on["specular"]})
    keep(tmp_path, cases["coat"], on)
    keep(tmp_path, cases["gain"], decided(specular="on", profile="on"), psnr=38.5, seconds=17.0)
    costly = decided(specular="on", gain="on", profile="on")
    costly["profile"]["render_ms"] = 3.0
    keep(tmp_path, cases["profile"], costly, psnr=39.75, seconds=24.0, peak_memory_mb=1100.0)
    return effects.rows(cases, 1, tmp_path, tmp_path, "sequence", "known")


def test_every_fitted_effect_is_forced_to_what_was_not_decided_and_shadows_only_beside_guides():
    found = {name: Decision(state["state"], "") for name, state in decided(specular="on").items()}
    rungs = effects.forced(BASE, found)
    assert set(rungs) == set(FITTED) - {"shadows"}
    assert rungs["specular"].effects == "specular=off" and rungs["coat"].effects == "coat=on"
    guided = effects.forced(BASE, {**found, "offset": Decision("on", "")})
    assert guided["offset"].effects == "offset=off" and guided["shadows"].effects == "shadows=on"


def test_a_gain_is_with_less_without_whichever_of_the_two_was_forced(rows):
    by_effect = {row["effect"]: row for row in rows}
    gain, profile = by_effect["gain"], by_effect["profile"]
    assert (gain["psnr_gain"], gain["seconds_added"], gain["render_ms"]) == (1.5, 3.0, 7.0)
    assert (profile["psnr_gain"], profile["seconds_added"], profile["render_ms"]) == (-0.25, 4.0, 3.0)
    assert profile["peak_memory_added_mb"] == 100 and profile["probe_db"] == 0.1
    assert (gain["state"], gain["forced"], gain["also"]) == ("on", "off", "profile on")
    assert gain["commands"][1] == ["fit", "twin", "--effects", "gain=off", "--seed", "0"]
    assert [row["effect"] for row in rows] == [
        effects.AS_DECIDED, *(name for name in FITTED if name != "shadows"), *RENDERED,
    ]  # fmt: skip


def test_the_section_tells_the_evidence_and_what_could_not_be_forced(rows, tmp_path):
    draw_effects(rows, [tmp_path / "effects.png", tmp_path / "effects.svg"])
    assert cv2.imread(str(tmp_path / "effects.png")).std() > 1
    page = section(rows, tmp_path)
    assert "&lt;coat&gt;; could not be forced: still off" in page
    assert "&lt;gain&gt;; forced off, the fit also decided profile on" in page
    assert page.count("<tr ") == len(rows) - 1 and section([], tmp_path) == ""
    assert ["gain", "on", "+0.10", "+1.50", "+0.00", "+3.0 s", "+0 MB", "7.0 ms", "0 MB"] in table(rows)


def test_effects_are_compared_only_where_they_are_fitted_and_may_cost_time():
    for name, told in {"method=endopbr": "fits no effects", "draft": "has a budget"}.items():
        with pytest.raises(OptionError, match=told):
            effects.base(name)
    assert effects.base("draft+budget=null").config.fit.budget is None


coordinates = st.lists(st.tuples(st.floats(0, 10), st.floats(-3, 3)), min_size=1, max_size=12)


@given(coordinates)
def test_names_of_points_that_are_near_lie_a_line_apart_and_none_above_its_point(points):
    x, y = np.array(points).T
    heights = _apart(x, y, near=2.0, line=0.3)
    height = np.array([heights[index] for index in range(len(x))])
    assert (height <= y).all()
    overlap = (abs(x[:, None] - x) < 2.0) & (abs(height[:, None] - height) < 0.3 - 1e-9)
    assert (overlap == np.eye(len(x), dtype=bool)).all()


def test_what_was_measured_before_a_stop_is_not_measured_again(rows, tmp_path, monkeypatch):
    sequence = open_sequence(tube_sequence.write(tmp_path / "tube", frames=3))
    monkeypatch.setattr(effects, "timed", None)
    monkeypatch.setattr(effects, "measured", None)
    cases = effects.measure(BASE, sequence, 1, "known", tmp_path)
    assert [row["rung"] for row in rows if "rung" in row] == [case.name for case in cases.values()]

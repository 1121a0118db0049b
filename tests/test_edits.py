"""Edits of materials and light: their arithmetic, their limits, and what is refused."""

import numpy as np
import pytest

from endotwin.errors import OptionError
from endotwin.fit.model import GAMMA
from endotwin.fit.state import GLOBAL_RANGE
from endotwin.synth.variation.edits import (
    GAMMA_LEAST,
    edit_light,
    edit_materials,
    parse_light_edit,
    parse_material_edit,
)
from endotwin.twin import Light, Materials

VALUES = np.array([0.0, 0.2, 0.5, 0.9], np.float32)
MATERIALS = Materials(np.stack([VALUES, VALUES / 2, VALUES / 4], axis=1), VALUES, VALUES / 10)
LIGHT = Light(L0=40.0, n=2.0, q=1.9)


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        ("roughness*1.3", "roughness", [0.0, 0.26, 0.65, 1.0]),
        ("roughness + 0.05", "roughness", [0.05, 0.25, 0.55, 0.95]),
        ("roughness-0.3", "roughness", [0.0, 0.0, 0.2, 0.6]),
        ("metallic=0.1", "metallic", [0.1, 0.1, 0.1, 0.1]),
        ("metallic-2", "metallic", [0.0, 0.0, 0.0, 0.0]),
        ("base_color*1e1", "base_color", [[0, 0, 0], [1, 1, 0.5], [1, 1, 1], [1, 1, 1]]),
    ],
)
def test_a_material_edit_is_its_arithmetic_kept_within_0_and_1(text, name, expected):
    before = getattr(MATERIALS, name).copy()
    edited = edit_materials(MATERIALS, [parse_material_edit(text)])
    np.testing.assert_allclose(getattr(edited, name), expected, atol=1e-6)
    assert getattr(edited, name).dtype == np.float32
    np.testing.assert_array_equal(getattr(MATERIALS, name), before)


def test_an_edit_leaves_the_other_materials_as_they_are():
    edited = edit_materials(MATERIALS, [parse_material_edit("roughness=1")])
    assert edited.base_color is MATERIALS.base_color and edited.metallic is MATERIALS.metallic
    assert edited.f0 == MATERIALS.f0


def test_edits_are_applied_in_the_order_given():
    first_times = [parse_material_edit("roughness*2"), parse_material_edit("roughness-0.1")]
    first_minus = list(reversed(first_times))
    np.testing.assert_allclose(
        edit_materials(MATERIALS, first_times).roughness, [0, 0.3, 0.9, 0.9], atol=1e-6
    )
    np.testing.assert_allclose(edit_materials(MATERIALS, first_minus).roughness, [0, 0.2, 0.8, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("intensity*0.8", Light(32.0, 2.0, 1.9)),
        ("n=1.5", Light(40.0, 1.5, 1.9)),
        ("q*1", Light(40.0, 2.0, 1.9)),
        ("n-5", Light(40.0, 0.0, 1.9)),
    ],
)
def test_a_light_edit_changes_one_parameter_and_never_below_0(text, expected):
    assert edit_light(LIGHT, [parse_light_edit(text)]) == expected


@pytest.mark.parametrize("text", ["roughness*1.3", "base_color=0.25", "metallic-1e-07", "roughness+-0.5"])
def test_an_edit_reads_back_from_how_it_prints(text):
    edit = parse_material_edit(text)
    assert parse_material_edit(str(edit)) == edit


@pytest.mark.parametrize(
    "text",
    ["gloss*2", "roughness", "roughness*", "roughness/2", "roughness*nan", "roughness=inf", "intensity*2", "",
     "roughness*__import__('os')", "roughness*1 metallic*2"],
)  # fmt: skip
def test_a_material_edit_that_is_not_understood_is_refused_with_what_is_allowed(text):
    with pytest.raises(OptionError, match=r"base_color, roughness, metallic"):
        parse_material_edit(text)


@pytest.mark.parametrize("text", ["roughness*-1", "base_color=-0.1", "metallic=1.01", "base_color.r*-2"])
def test_a_material_that_cannot_be_is_refused(text):
    with pytest.raises(OptionError, match=r"cannot be negative|between 0 and 1"):
        parse_material_edit(text)


def test_a_light_that_cannot_be_is_refused_and_an_offset_may_be_negative():
    for text in ("intensity=-5", "n*-1", "color.r=-1"):
        with pytest.raises(OptionError, match="cannot be negative"):
            parse_light_edit(text)
    assert parse_light_edit("offset.x=-2").number == -2


@pytest.mark.parametrize("text", ["roughness*2", "L0*2", "gamma*2", "intensity*-inf", "n"])
def test_a_light_edit_that_is_not_understood_is_refused_with_what_is_allowed(text):
    with pytest.raises(OptionError, match=r"intensity, n, q"):
        parse_light_edit(text)


def test_the_least_gamma_of_an_edit_is_that_of_a_fit():
    assert GLOBAL_RANGE[GAMMA][0] == GAMMA_LEAST

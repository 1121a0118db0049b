"""Frames of changing draws: what they share is made once, and no frame shows the draws before it."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin

from endotwin.effects import Effects, effect_class
from endotwin.render import Renderer, illumination
from endotwin.synth import Trajectory, fixed, parse_labels, parse_material_edit
from endotwin.synth.labels import Labeller
from endotwin.synth.run.dataset import make_job
from endotwin.synth.variation import read_variation
from endotwin.synth.variation.edits import edit_materials

FRAMES = 6
VARIED = {
    "light": "light: [intensity*0.5..1.5, n*0.9..1.1, offset.x+-2..2]",
    "material": "material: [roughness*0.5..1.5, metallic=0..0.5]\nresponse: [gain*0.5..2]",
    "effects": "effects: {interreflection: 0.5, coat: 0.5}\nlight: [color.r*0.5..1]",
    "parameters": "parameters: [interreflection.cell_mm*0.7..1.4, vignetting.k2*0.5..2]",
}


@pytest.fixture(scope="module")
def twin():
    """A tube with bounced light and vignetting."""
    effects = [effect_class("interreflection")(cell_mm=6.0), effect_class("vignetting")(k2=-0.3)]
    return replace(tube_twin.fitted(tube_twin.seen(tube_twin.surface())), effects=Effects(effects))


def labeller(twin, variation) -> Labeller:
    poses = np.repeat(tube_twin.pose(0.3)[None], FRAMES, axis=0)
    trajectory = Trajectory(poses, np.arange(FRAMES) / 30, "one pose")
    labels = parse_labels("rgb,rgb_exr,diffuse,roughness")
    return Labeller(make_job(twin, trajectory, 0, labels, "c3vd", twin.camera, variation))


@pytest.mark.parametrize("kind", VARIED)
def test_a_frame_is_the_same_whatever_was_drawn_before_it(twin, tmp_path, kind):
    (tmp_path / "vary.yaml").write_text(VARIED[kind])
    variation = read_variation(tmp_path / "vary.yaml", twin, fixed())
    one_after_the_other = labeller(twin, variation)
    pictures = set()
    for index in range(FRAMES):
        images, alone = one_after_the_other.frame(index), labeller(twin, variation).frame(index)
        for name in images:
            np.testing.assert_array_equal(images[name], alone[name], err_msg=f"{index} {name}")
        pictures.add(images["rgb_exr"].tobytes())
    assert len(pictures) > 3


@pytest.mark.parametrize("kind", ["light", "material", "effects"])
def test_form_factors_are_counted_once_for_all_draws(twin, tmp_path, monkeypatch, kind):
    counted = []

    class Counted(illumination.Radiosity):
        def __init__(self, *arguments):
            counted.append(arguments)
            super().__init__(*arguments)

    monkeypatch.setattr(illumination, "Radiosity", Counted)
    (tmp_path / "vary.yaml").write_text(VARIED[kind])
    varied = labeller(twin, read_variation(tmp_path / "vary.yaml", twin, fixed()))
    for index in range(FRAMES):
        varied.frame(index)
    assert len(counted) == 1


def test_metallic_tissue_bounces_as_little_light_as_darker_tissue(twin):
    """Diffuse light is (1 − metallic)·base_color, also where it lights other tissue."""
    pose = tube_twin.pose(0.3)

    def radiance(*edits: str) -> np.ndarray:
        materials = edit_materials(twin.materials, map(parse_material_edit, edits))
        return Renderer(replace(twin, materials=materials)).view(pose).radiance

    metallic, darker = radiance("metallic=0.5"), radiance("metallic=0", "base_color*0.5")
    np.testing.assert_allclose(metallic, darker, rtol=1e-5, atol=1e-7)
    assert metallic.sum() < 0.6 * radiance("metallic=0").sum()

"""Variation: what is drawn lies in its range, is written for every frame, and is what the picture shows."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
import tube_twin

from endotwin import pipeline
from endotwin.effects.offset import Offset
from endotwin.errors import OptionError
from endotwin.sequence.poses import write_c3vd_poses
from endotwin.synth import Trajectory, fixed, make_job, parse_light_edit, parse_material_edit, synthesize
from endotwin.synth.variation import Variation, read_variation

RANGES = """
per: clip
clip: 3
material:
  - roughness*0.8..1.2
  - base_color.r+-0.1..0.1
light:
  - intensity*0.5..1.5
  - n=1..3
  - color.b*0.7..1
response:
  - gamma*0.9..1.1
  - gain*0.8..1.25
regions:
  - name: polyp
    box: [[-100, 0, -100], [100, 100, 100]]
    material: [metallic=0.5, base_color=0.2..0.3]
"""


TWICE = "{name: twice, box: [[-100, 0, -100], [100, 100, 100]]}"


@pytest.fixture(scope="module")
def twin():
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


@pytest.fixture
def ranges(twin, tmp_path):
    def read(text: str) -> Variation:
        (tmp_path / "vary.yaml").write_text(text)
        return read_variation(tmp_path / "vary.yaml", twin, fixed())

    return read


def test_what_is_drawn_for_a_pose_does_not_depend_on_those_that_are_dropped(ranges):
    read = ranges("material: base_color.r*0.5..1.5")
    whole, left = read.draw(range(6), 0), replace(along(4), numbers=np.array([0, 2, 3, 5]))
    assert read.draw(left.originals, 0) == tuple(whole[k] for k in (0, 2, 3, 5))
    assert read.draw(along(6).originals, 0) == whole


def test_blur_that_is_drawn_needs_poses_that_follow_each_other(twin, ranges):
    blurred = ranges("effects: {motion_blur: 0.9}")
    apart, path = replace(along(8), successive=False), replace(along(8), spec="jitter")
    with pytest.raises(OptionError, match="those of jitter do not"):
        make_job(twin, apart, 0, ("rgb",), "c3vd", twin.camera, blurred)
    assert make_job(twin, path, 0, ("rgb",), "c3vd", twin.camera, blurred).draws


def test_poses_at_one_time_are_refused(twin):
    still = replace(along(3), timestamps_s=np.array([0, 0, 1 / 30]))
    with pytest.raises(OptionError, match="do not rise"):
        make_job(twin, still, 0, ("rgb", "depth"), "tum", twin.camera, fixed())


def along(count: int) -> Trajectory:
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.2, 0.5, count)])
    return Trajectory(poses, np.arange(count) / 30, "along the axis")


def test_draws_lie_in_their_ranges_change_with_the_clip_and_follow_the_seed(ranges):
    read = ranges(RANGES)
    draws = read.draw(range(300), seed=4)
    assert draws == read.draw(range(300), seed=4) and draws != read.draw(range(300), seed=5)
    assert draws[:10] == read.draw(range(10), seed=4)
    assert all(draws[k] == draws[k // 3 * 3] for k in range(300)) and len(set(draws)) == 100
    intensity = np.array([draw.light[0].number for draw in draws[::3]])
    assert 0.5 <= intensity.min() < 0.56 and 1.44 < intensity.max() <= 1.5
    shifts = np.array([draw.material[1].number for draw in draws[::3]])
    assert abs(np.corrcoef(intensity, shifts)[0, 1]) < 0.3


def test_a_draw_edits_channels_regions_light_and_response(ranges, twin):
    read = ranges(RANGES)
    draw = read.draw(range(1), seed=0)[0]
    edited, exposure = draw.edited(twin, read.regions)
    inside = (twin.surface.vertices_mm + twin.surface.origin_mm)[:, 1] >= 0
    before, after = twin.materials, edited.materials
    np.testing.assert_array_equal(after.metallic[inside], 0.5)
    np.testing.assert_array_equal(after.metallic[~inside], before.metallic[~inside])
    assert len(np.unique(after.base_color[inside])) == 1
    red = np.clip(before.base_color[~inside, 0] + draw.material[1].number, 0, 1)
    np.testing.assert_allclose(after.base_color[~inside, 0], red, atol=1e-6)
    np.testing.assert_array_equal(after.base_color[~inside, 1:], before.base_color[~inside, 1:])
    assert edited.light.n == draw.light[1].number
    assert edited.response.gamma == pytest.approx(twin.response.gamma * draw.response[0].number)
    gain = draw.response[1].number
    np.testing.assert_allclose(exposure, [gain, gain, gain * draw.light[2].number], rtol=1e-6)


def test_the_file_tells_of_every_frame_what_its_picture_shows(twin, tmp_path):
    """Gain and the light's colour scale the linear picture by just what frames.jsonl says."""
    (tmp_path / "vary.yaml").write_text("response: gain*0.4..0.9\nlight: [color.b*0.5..1]")
    write_c3vd_poses(tmp_path / "poses.txt", along(5).T_world_camera)
    bright = replace(twin, light=replace(twin.light, L0=400.0))
    for name, options in (("plain", {}), ("varied", {"vary": tmp_path / "vary.yaml"})):
        pipeline.synthesize(
            bright, str(tmp_path / "poses.txt"), tmp_path / name, labels="rgb_linear", seed=3, **options
        )
    lines = (tmp_path / "varied" / "frames.jsonl").read_text().splitlines()
    gains = []
    for index, record in enumerate(map(json.loads, lines)):
        plain, varied = (
            cv2.imread(str(tmp_path / name / f"{index:04d}_rgb_linear.png"), cv2.IMREAD_UNCHANGED).astype(
                float
            )
            for name in ("plain", "varied")
        )
        gain, blue = (float(record[kind][0].split("*")[1]) for kind in ("response", "light"))
        clear = (plain > 2000) & (plain < 65535)
        assert clear[..., 0].sum() > 20 and clear[..., 2].sum() > 20
        np.testing.assert_allclose((varied / plain)[clear[..., 2], 2], gain, rtol=2e-3)
        np.testing.assert_allclose((varied / plain)[clear[..., 0], 0], gain * blue, rtol=2e-3)
        gains.append(gain)
    assert len(set(gains)) == 5
    document = json.loads((tmp_path / "varied" / "dataset.json").read_text())
    assert document["variation"]["response"] == ["gain*0.4..0.9"]


def test_edits_of_the_command_line_come_before_the_ranges(twin, tmp_path):
    (tmp_path / "vary.yaml").write_text("material: roughness*0.5..0.5")
    before = fixed([parse_material_edit("roughness=0.6")], [parse_light_edit("n=1")])
    draw = read_variation(tmp_path / "vary.yaml", twin, before).draw(range(1), 0)[0]
    edited, _ = draw.edited(twin)
    np.testing.assert_allclose(edited.materials.roughness, 0.3, atol=1e-6)
    assert edited.light.n == 1


@pytest.mark.parametrize("kind", ["npy", "ply"])
def test_a_painted_region_takes_the_edit_by_its_weight(twin, tmp_path, kind):
    points = twin.surface.vertices_mm + twin.surface.origin_mm
    weight = np.clip((points[:, 1] + 12) / 24, 0, 1)
    if kind == "npy":
        np.save(tmp_path / "mask.npy", weight)
    else:
        colors = np.repeat(np.rint(weight * 255).astype(np.uint8)[:, None], 3, axis=1)
        order = np.random.default_rng(0).permutation(len(points))
        mesh = trimesh.Trimesh(points[order], np.argsort(order)[twin.surface.triangles], process=False)
        mesh.visual.vertex_colors = colors[order]
        mesh.export(tmp_path / "mask.ply")
    (tmp_path / "vary.yaml").write_text(
        f"regions: [{{name: patch, vertices: mask.{kind}, material: [roughness=1]}}]"
    )
    read = read_variation(tmp_path / "vary.yaml", twin, fixed())
    edited, _ = read.draw(range(1), 0)[0].edited(twin, read.regions)
    expected = twin.materials.roughness * (1 - weight) + weight
    np.testing.assert_allclose(edited.materials.roughness, expected, atol=0.003)


def test_effects_are_switched_by_their_chance_and_their_parameters_drawn(ranges, twin):
    read = ranges("effects: {coat: 0.25, noise: on}\nparameters: [coat.weight*0.5..2, noise.read_noise+9]")
    draws = read.draw(range(400), 0)
    assert 0.18 < np.mean([dict(draw.effects)["coat"] for draw in draws]) < 0.32
    with_coat = next(draw for draw in draws if dict(draw.effects)["coat"])
    without = next(draw for draw in draws if not dict(draw.effects)["coat"])
    edited, _ = with_coat.edited(twin)
    assert edited.effects["coat"].weight == pytest.approx(with_coat.parameters[0].number)
    assert edited.effects["noise"].read_noise == 0.2  # its upper bound
    assert list(without.edited(twin)[0].effects) == ["noise"]
    assert with_coat.to_dict()["effects"] == {"coat": "on", "noise": "on"}
    off = ranges("effects: {coat: off}").draw(range(1), 0)[0]
    assert "coat" not in off.edited(edited)[0].effects


def test_a_parameter_may_be_negative_where_its_limits_are(ranges):
    assert ranges("parameters: [vignetting.k2=-1..0.5]").parameters[0].low == -1


def test_the_lights_offset_moves_every_guide(ranges, twin):
    draw = ranges("light: [offset.x+2..2, offset.y*0.5]").draw(range(1), 0)[0]
    beside, _ = draw.edited(twin)
    assert beside.effects.guides_mm == ((2.0, 0.0, 0.0),) and "shadows" in beside.effects
    two = replace(twin, effects=twin.effects.including(Offset(((1.0, 2.0, 0.0), (-3.0, 2.0, 0.0)))))
    moved = draw.edited(two)[0].effects
    assert moved.guides_mm == ((3.0, 1.0, 0.0), (-1.0, 1.0, 0.0)) and "shadows" not in moved
    unshadowed = replace(draw, effects=(("shadows", False),))
    assert "shadows" not in unshadowed.edited(twin)[0].effects


def test_varied_frames_do_not_depend_on_where_a_run_stopped(ranges, twin, tmp_path):
    read, stops = ranges(RANGES), []

    def stop(label, done, total):
        if not stops:
            stops.append(done)
            raise KeyboardInterrupt

    synthesize(twin, along(20), tmp_path / "whole", variation=read, seed=1)
    with pytest.raises(KeyboardInterrupt):
        synthesize(twin, along(20), tmp_path / "parts", variation=read, seed=1, progress=stop)
    synthesize(twin, along(20), tmp_path / "parts", variation=read, seed=1, progress=stop)
    for file in (tmp_path / "whole").iterdir():
        assert (tmp_path / "parts" / file.name).read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("colour: 3", r"'colour' is not understood.*material"),
        ("material: [gloss*1..2]", "no 'gloss' to edit"),
        ("material: [roughness*2..1]", "wrong way round"),
        ("material: [roughness*1..]", "not a finite number|not understood"),
        ("material: {roughness: 2}", "no list"),
        ("light: [intensity*nan]", "finite"),
        ("per: month", "frame or clip"),
        ("per: clip\nclip: 0", "number of frames"),
        ("effects: {confetti: on}", r"confetti.*noise"),
        ("effects: {offset: on}", "no defaults"),
        ("effects: {noise: [0.5]}", r"'noise' is \[0\.5\]; write on, off, or a chance"),
        ("effects: {noise: {on: 0.5}}", "write on, off, or a chance"),
        ("parameters: [noise.colour*2]", r"noise\.read_noise"),
        ("parameters: [noise.read_noise=9]", r"read_noise lies between 0 and 0\.2"),
        ("parameters: [noise.read_noise=0.1..0.3]", r"read_noise lies between 0 and 0\.2"),
        ("parameters: [noise.read_noise*-1..1]", "cannot be negative"),
        ("response: [gamma=0]", r"at least 0\.15"),
        ("response: [gamma*0.001..1]", r"at least 0\.15"),
        ("regions: [{name: a, material: []}]", "lacks a part"),
        ("regions: [{name: a, box: [1, 2], material: []}]", "two corners"),
        ("regions: [{name: a, box: [[500, 0, 0], [501, 1, 1]]}]", "no vertex"),
        ("regions: [{name: a, vertices: nowhere.npy}]", "nowhere"),
        ("regions: 3", "no list"),
        (f"regions: [{TWICE}, {TWICE}]", "two regions are called 'twice'"),
        ("material: [", "YAML"),
        pytest.param("[" * 20_000, "nested too deeply", id="deep"),
        ("regions: [{name: p, vertices: paint.txt}]", "is no vertex mask"),
        ("regions: [{name: p, vertices: paint.ply}]", "is no vertex mask"),
        ("[1, 2]", "no keys"),
    ],
)
def test_a_file_that_is_not_understood_is_refused_with_its_name(ranges, text, told):
    with pytest.raises(OptionError, match=told) as refused:
        ranges(text)
    assert any(name in str(refused.value) for name in (".yaml", ".npy", "the twin"))

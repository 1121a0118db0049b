"""The library in other hands: what makes sense is taken, and the rest is refused by a typed sentence."""

import io
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import tube_sequence
import tube_twin

import endotwin
from endotwin.cameras import write_camera
from endotwin.config import FuseConfig, load_config
from endotwin.errors import CameraError, EndotwinError, OptionError, TrajectoryError, TwinError
from endotwin.surface.silhouettes import discontinuities


@pytest.fixture(scope="module")
def twin() -> endotwin.Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A sequence ``tube`` and its twin ``twin``, which is not fitted."""
    folder = tmp_path_factory.mktemp("made")
    tube_sequence.write(folder / "tube", 4, 48, 36)
    endotwin.fuse_twin(folder / "tube").save(folder / "twin")
    return folder


def test_a_pose_may_be_a_list(twin):
    pose = tube_twin.pose(0.5)
    renderer = endotwin.Renderer(twin)
    np.testing.assert_array_equal(renderer.view(pose.tolist()).color, renderer.view(pose).color)


def test_a_render_is_the_renderers_view_through_any_camera(twin):
    pose = tube_twin.pose(0.5)
    for camera in (None, twin.camera.scaled(0.5), twin.camera):
        mine, its = twin.render(pose, camera), endotwin.Renderer(twin, camera).view(pose)
        for name in ("color", "radiance", "depth_mm", "normals", "mask"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(its, name))
    assert mine.color.shape == (72, 96, 3) and mine.depth_mm.shape == mine.mask.shape == (72, 96)


def test_the_albedo_of_a_view_is_the_base_colour_that_lambert_shows(twin):
    matte = replace(
        twin,
        materials=replace(twin.materials, f0=0.0, diffuse="lambert", metallic=0 * twin.materials.metallic),
    )
    view = matte.render(tube_twin.pose(0.5))
    inner = ~discontinuities(np.nan_to_num(view.depth_mm)) & view.mask
    ratio = view.radiance[inner] / view.albedo[inner]
    np.testing.assert_allclose(ratio, ratio[:, :1].repeat(3, axis=1), rtol=1e-2)
    assert view.albedo[~view.mask].max(initial=0) == 0


@pytest.mark.parametrize("of", ["to_trimesh", "to_open3d", "to_pyvista"])
def test_meshes_of_other_libraries_have_every_vertex_and_every_map(twin, of):
    mesh = getattr(twin, of)()
    if of == "to_trimesh":
        points, triangles, normals, maps = (
            mesh.vertices,
            mesh.faces,
            mesh.vertex_normals,
            mesh.vertex_attributes,
        )
    elif of == "to_open3d":
        maps = {name: mesh.vertex[name].numpy().squeeze() for name in mesh.vertex}
        points, normals, triangles = maps["positions"], maps["normals"], mesh.triangle.indices.numpy()
    else:
        points, triangles, maps = mesh.points, mesh.regular_faces, dict(mesh.point_data)
        normals = maps["normals"]
    surface = twin.surface
    np.testing.assert_allclose(points, surface.vertices_mm + surface.origin_mm, atol=1e-5)
    np.testing.assert_array_equal(triangles, surface.triangles)
    np.testing.assert_allclose(normals, surface.normals, atol=1e-6)
    known = {**twin.materials.per_vertex, "seen_by": surface.seen_by, "nearest_mm": surface.nearest_mm}
    for name, values in known.items():
        np.testing.assert_array_equal(maps[name], values)


def test_the_mesh_of_trimesh_can_be_written_with_every_map(twin):
    written = trimesh.exchange.ply.load_ply(io.BytesIO(twin.to_trimesh().export(file_type="ply")))
    rows = written["metadata"]["_ply_raw"]["vertex"]["data"]
    for name in ("roughness", "seen_by", "filled"):
        np.testing.assert_array_equal(rows[name], twin.to_trimesh().vertex_attributes[name])


def test_a_twin_that_has_been_rendered_can_go_to_another_process(twin):
    pose = tube_twin.pose(0.5)
    seen = twin.render(pose).color
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(twin)).render(pose).color, seen)


def test_scores_are_kept_in_the_folder_that_was_named_and_handed_over_for_a_twin(made, tmp_path):
    fitted = endotwin.fit_twin(made / "twin", budget_s=1)
    fitted.save(tmp_path / "twin")
    evaluation = endotwin.evaluate(tmp_path / "twin")
    kept = endotwin.Twin.load(tmp_path / "twin").record["eval"]
    assert kept == evaluation.to_dict() == evaluation.twin.record["eval"]
    assert f"held out: {evaluation.psnr:.2f} dB" in str(evaluation.twin)
    assert "eval" not in fitted.record and "held out" not in str(fitted)


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        (np.eye(3), r"matrices \[N, 4, 4\].*\(3, 3\)"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.diag([2.0, 1, 1, 1]), "not rigid"),
        ("pose.txt", "str"),
        (None, "NoneType"),
        ([[1, 2], [3]], "list"),
        ([], "list"),
    ],
)
def test_what_is_no_pose_is_refused(twin, pose, says):
    with pytest.raises(TrajectoryError, match=says):
        endotwin.Renderer(twin).view(pose)


def test_a_mask_of_another_shape_is_refused(twin):
    with pytest.raises(OptionError, match=r"\(2, 2\)"):
        endotwin.Renderer(twin).view(tube_twin.pose(0.5), np.ones((2, 2), bool))


@pytest.mark.parametrize("form", [np.asarray, list, lambda poses: poses.tolist()])
def test_a_trajectory_may_be_an_array_and_an_edit_a_string(twin, tmp_path, form):
    poses = np.stack([tube_twin.pose(s) for s in (0.4, 0.5)])
    made = endotwin.synthesize(
        twin, form(poses), tmp_path / "one", material="roughness*1.3", light="intensity*0.8", labels=["rgb"]
    )
    assert made.frames == 2
    file = tmp_path / "pose.txt"
    file.write_text("".join(",".join(map(repr, pose.T.ravel().tolist())) + "\n" for pose in poses))
    options = {"material": ["roughness*1.3"], "light": ["intensity*0.8"], "labels": "rgb"}
    endotwin.synthesize(twin, file, tmp_path / "two", **options)
    for name in ("0000_color.png", "0001_color.png", "pose.txt"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.parametrize("poses", [np.eye(3)[None], np.zeros((0, 4, 4)), np.eye(4)[None] * 1e9, 7])
def test_poses_that_cannot_be_rendered_are_refused(twin, tmp_path, poses):
    with pytest.raises(TrajectoryError):
        endotwin.synthesize(twin, poses, tmp_path / "dataset")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("edit", ["roughness", "gloss*2", ["r", "o"], ""])
def test_an_edit_that_makes_no_sense_is_named(twin, tmp_path, edit):
    with pytest.raises(OptionError):
        endotwin.synthesize(twin, [tube_twin.pose(0.5)], tmp_path / "dataset", material=edit)


@pytest.mark.parametrize("labels", ["", [], "rgb,colour"])
def test_labels_that_are_none_are_refused(twin, tmp_path, labels):
    with pytest.raises(OptionError, match="no label"):
        endotwin.synthesize(twin, [tube_twin.pose(0.5)], tmp_path / "dataset", labels=labels)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"seed": 1.5}, {"seed": -1}, {"labels": 3}, {"material": 3}, {"light": [1]}, {"motion": 3}),
        *({"workers": "x"}, {"workers": -1}, {"effects": ["noise"]}, {"effects": {"noise": "maybe"}}),
        *({"polyps": {"Is": 6}}, {"limits": 3}, {"limits": {"unknown": 0.5}}, {"progress": 3}),
        *({"vary": 3}, {"vary": {}}, {"scheduler": 3}),
    ],
)
def test_arguments_of_another_type_are_refused(twin, tmp_path, wrong):
    with pytest.raises(OptionError, match="|".join([*wrong, "choice of an effect", "file of ranges"])):
        endotwin.synthesize(twin, [tube_twin.pose(0.5)], tmp_path / "dataset", **wrong)


def test_arguments_of_another_type_end_no_fuse_or_fit_halfway(twin, made):
    for told, wrong in (
        ("scale", {"scale": "0.5"}),
        ("frame", {"without": 3.5}),
        ("frames to leave out", {"without": None}),
        ("progress", {"progress": 3}),
        ("no config 'drafty'", {"config": "drafty"}),
        ("FuseConfig, and not as dict", {"config": {"scale": 0.5}}),
        ("width and a height", {"undistort": 64}),
    ):
        with pytest.raises(OptionError, match=told):
            endotwin.fuse_twin(made / "tube", **wrong)
    for told, wrong in (
        ("budget", {"budget_s": "10s"}),
        ("epochs", {"method": "endopbr", "epochs": 1.5}),
        ("gian=on", {"effects": {"gian": "on"}, "align": "off"}),
        ("gain=maybe", {"effects": {"gain": "maybe"}, "align": "off"}),
        ("progress", {"progress": 3}),
        ("checkpoint", {"checkpoint": 3}),
        ("no config 'drafty'", {"config": "drafty"}),
        ("FitConfig, and not as FuseConfig", {"config": FuseConfig()}),
    ):
        with pytest.raises(OptionError, match=told):
            endotwin.fit_twin(twin, **wrong)


@pytest.mark.parametrize("no_path", [None, 3, True])
@pytest.mark.parametrize(
    "call",
    [
        lambda twin, path: twin.save(path),
        lambda twin, path: twin.export(path),
        lambda twin, path: endotwin.Twin.load(path),
        lambda twin, path: endotwin.synthesize(twin, "jitter:frames=1", path),
        lambda twin, path: endotwin.evaluate(twin, sheet=path or 0),
        lambda twin, path: endotwin.evaluate(twin, renders=path or 0),
        lambda twin, path: endotwin.inspect(twin, screenshot=path or 0),
        lambda twin, path: endotwin.open_sequence(path),
    ],
)
def test_what_is_no_path_is_refused(twin, call, no_path):
    with pytest.raises(OptionError, match="is given by its path, and not as"):
        call(twin, no_path)


@pytest.mark.parametrize("no_camera", [3, 0, {"model": "pinhole"}])
def test_what_is_no_camera_is_refused(twin, tmp_path, no_camera):
    pose = tube_twin.pose(0.5)
    for call in (
        lambda: twin.render(pose, no_camera),
        lambda: endotwin.Renderer(twin, no_camera),
        lambda: endotwin.synthesize(twin, [pose], tmp_path / "dataset", camera=no_camera),
    ):
        with pytest.raises(CameraError, match="is no camera"):
            call()


@pytest.mark.parametrize("scale", ["1", None, np.nan])
def test_what_is_no_scale_is_refused(twin, made, scale):
    for call in (
        lambda: endotwin.open_sequence(made / "tube", scale=scale),
        lambda: twin.camera.scaled(scale),
    ):
        with pytest.raises(OptionError, match="the scale is"):
            call()


def test_a_dataset_may_be_seen_through_a_camera_that_is_no_file(twin, tmp_path):
    camera, poses = twin.camera.scaled(0.5), [tube_twin.pose(0.5)]
    write_camera(tmp_path / "camera.json", camera)
    for name, given in {"object": camera, "file": tmp_path / "camera.json"}.items():
        endotwin.synthesize(twin, poses, tmp_path / name, camera=given)
    for file in (tmp_path / "file").iterdir():
        assert (tmp_path / "object" / file.name).read_bytes() == file.read_bytes()


def test_numbers_of_numpy_are_those_of_python(twin, made, tmp_path):
    poses = [tube_twin.pose(0.5)]
    for name, seed in (("numpy", np.int64(3)), ("python", 3)):
        endotwin.synthesize(twin, poses, tmp_path / name, seed=seed, workers=np.int64(1))
    assert (tmp_path / "numpy/dataset.json").read_bytes() == (tmp_path / "python/dataset.json").read_bytes()
    endotwin.with_polyps(twin, "Is:size=3", seed=np.int64(1)).save(tmp_path / "grown")
    for name, options in {
        "scaled": {"scale": np.float32(0.5), "voxel_mm": np.float32(2), "without": np.array([1])},
        "undistorted": {"undistort": tuple(np.array([32, 24]))},
    }.items():
        fused = endotwin.fuse_twin(made / "tube", **options)
        fused.save(tmp_path / name)
        assert endotwin.Twin.load(tmp_path / name).source == fused.source
    fitted = endotwin.fit_twin(fused, seed=np.int64(1), budget_s=np.float32(1))
    fitted.save(tmp_path / "fitted")


def test_a_config_may_be_named_as_on_the_command_line(made, tmp_path):
    (tmp_path / "own.yaml").write_text("fuse: {scale: 0.5}\nfit: {budget: 1s}\neffects: {vignetting: off}\n")
    assert endotwin.fuse_twin(made / "tube", config="draft").record["fuse"]["config"]["frames"] == 24
    fused = endotwin.fuse_twin(made / "tube", config=tmp_path / "own.yaml")
    assert fused.source.scale == 0.5
    fitted = endotwin.fit_twin(fused, config=str(tmp_path / "own.yaml"))
    assert fitted.decisions["vignetting"].state == "off" and "align" not in fitted.record
    whole = load_config(tmp_path / "own.yaml")
    assert endotwin.fuse_twin(made / "tube", config=whole).source.scale == 0.5


def test_a_view_is_from_one_pose(twin):
    with pytest.raises(TrajectoryError, match="one pose"):
        twin.render(np.repeat(tube_twin.pose(0.5)[None], 2, axis=0))


def test_a_twin_may_be_named_by_its_folder(made, tmp_path):
    fitted = endotwin.fit_twin(made / "twin", budget_s=1)
    fitted.save(tmp_path / "twin")
    assert endotwin.evaluate(str(tmp_path / "twin")).frames
    assert endotwin.Renderer(tmp_path / "twin").twin.fitted
    assert endotwin.synthesize(tmp_path / "twin", "jitter:frames=1", tmp_path / "dataset").frames == 1
    endotwin.inspect(tmp_path / "twin", tmp_path / "twin.png", "roughness")


@pytest.mark.parametrize(
    "call",
    [
        lambda twin: endotwin.fit_twin(twin),
        lambda twin: endotwin.evaluate(twin),
        lambda twin: endotwin.Renderer(twin),
        lambda twin: endotwin.synthesize(twin, "jitter:", "nowhere"),
        lambda twin: endotwin.inspect(twin),
    ],
)
@pytest.mark.parametrize("no_twin", [None, 3, "nowhere"])
def test_what_is_no_twin_is_refused(call, no_twin):
    with pytest.raises(TwinError, match=r"no twin|not a twin"):
        call(no_twin)


@pytest.mark.parametrize("call", [endotwin.open_sequence, endotwin.fuse_twin])
@pytest.mark.parametrize("no_sequence", [None, 3, "nowhere"])
def test_what_is_no_sequence_is_refused(call, no_sequence):
    with pytest.raises(EndotwinError):
        call(no_sequence)


def test_twins_and_their_parts_can_be_compared_and_kept_in_sets(twin):
    other = tube_twin.fitted(twin.surface)
    for mine, its in ((twin, other), (twin.materials, other.materials)):
        assert mine == mine and mine != its and len({mine, its, mine}) == 2
    assert twin.surface in {twin.surface}


def test_messages_of_the_library_name_what_python_calls_it(twin, made, tmp_path):
    with pytest.raises(EndotwinError, match="overwrite=True"):
        twin.save(made / "twin")
    with pytest.raises(OptionError) as refused:
        endotwin.fit_twin(made / "twin", epochs=3)
    assert "--" not in str(refused.value)

"""The scripts of benchmarks/ find what they import and measure; c3vd.py has a test of its own."""

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from endotwin.fusion.mesh import surface_of

SCRIPTS = sorted((Path(__file__).parents[1] / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_each_explains_itself(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0
    assert script.name in capsys.readouterr().out


def test_the_bounce_that_bench_bounce_compares_is_that_of_the_whole_where_the_wall_is_right():
    (script,) = (path for path in SCRIPTS if path.stem == "bench_bounce")
    bounced = runpy.run_path(str(script))["bounced"]
    ball = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    whole = surface_of(np.zeros(3), np.asarray(ball.vertices, np.float32), ball.faces[:, ::-1])
    upper = whole.vertices_mm[whole.triangles].mean(axis=1)[:, 2] > 0
    half = replace(
        whole,
        triangles=whole.triangles[upper],
        wall_mm=whole.vertices_mm,
        wall_triangles=whole.triangles[~upper],
    )
    places = np.flatnonzero(whole.vertices_mm[:, 2] > 0)
    points_mm, normals = whole.vertices_mm[places], whole.normals[places]
    of_whole, of_half = (bounced(each, points_mm, normals, np.eye(4)[None]) for each in (whole, half))
    assert of_whole.shape == (1, len(places)) and of_whole.min() > 0
    np.testing.assert_allclose(np.median(of_half / of_whole), 1, atol=0.03)

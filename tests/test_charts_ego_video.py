"""The chart of the ego video's renderers: what they have in common, and what is measured of them."""

from itertools import islice

import numpy as np
import pytest

from labeling.camera import prior_intrinsics
from labeling.ego_sphere import world_raster
from pipelines import charts_ego_video
from pipelines.charts import pareto_front
from pipelines.charts_ego_video import (
    EXACT,
    REFERENCE,
    TRIVIAL,
    chart,
    differences,
    looked_up,
    renderers,
    turning_drive,
)

CAMERA = prior_intrinsics(264, 176)


@pytest.fixture(scope="module")
def without_vtk():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(charts_ego_video, "missing_library", lambda: "no OpenGL here; install libosmesa6")
        yield chart("ego-video", quick=True)


def test_a_reference_that_cannot_run_is_said_to_be_left_out(without_vtk):
    assert without_vtk.left_out == (f"{REFERENCE}: no OpenGL here; install libosmesa6",)
    errors = {point.method: point.error.median for point in without_vtk.points}
    assert REFERENCE not in errors and errors[EXACT] == 0


def test_finer_grids_come_nearer_and_the_front_ends_at_the_reference(without_vtk):
    points = {point.method: point for point in without_vtk.points}
    (default,) = (name for name in points if "(default)" in name)
    assert default == "grid of 4 (default)", "the lens of a small picture asks for a finer grid"
    errors = [points[name].error.median for name in ("grid of 2", default, "grid of 8", "grid of 16")]
    assert errors == sorted(errors) and errors[-1] < points[TRIVIAL].error.median / 20
    assert points["released style (another look)"].more_errors[1].median < 1
    assert pareto_front(without_vtk.points)[0].method == TRIVIAL
    assert all(point.ms_per_frame.median > 0 for point in without_vtk.points if point.method != TRIVIAL)


def test_numpy_and_compiled_renderers_draw_the_same_sphere():
    found = renderers(CAMERA, with_reference=False)
    drive = turning_drive(24)
    pictures = {name: list(islice(found[name](drive), 3)) for name in (EXACT, "every pixel, numpy")}
    assert differences(*pictures.values()).max() < 0.5
    texture = world_raster(CAMERA).picture()
    assert looked_up(np.eye(4), texture, CAMERA, step=8).shape == (176, 264, 3)


def test_differences_with_and_without_edges():
    flat, split = np.zeros((20, 30, 3), np.uint8), np.zeros((20, 30, 3), np.uint8)
    split[:, 15:] = 200
    moved = np.roll(split, 1, axis=1)
    assert differences([flat], [flat]).tolist() == [0.0]
    assert differences([flat + 3], [flat], edges=False).tolist() == [3.0]
    assert differences([moved], [split])[0] > 5
    assert differences([moved[:, 1:-1]], [split[:, 1:-1]], edges=False)[0] == 0

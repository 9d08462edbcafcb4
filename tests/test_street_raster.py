"""The street's scan converter against brute force: coverage, depth, texture lookup, near clipping."""

import numpy as np
import pytest

from dataset.street_polygons import Atlas, blank_canvas, join, make_polygons, pack_rgb
from dataset.street_raster import paint

CAMERA = (100.0, 100.0, 49.5, 39.5)
WIDTH, HEIGHT = 100, 80


def plain_atlas(picture: np.ndarray) -> Atlas:
    """One texture with a full mip chain."""
    offset, texels = [], []
    at, logs = 0, []
    level = picture.astype(np.float64)
    while True:
        logs.append(int(np.log2(len(level))))
        offset.append(at)
        texels.append(pack_rgb(np.round(level).astype(np.uint8).reshape(-1, 3)))
        at += level.shape[0] * level.shape[1]
        if len(level) == 2:
            break
        level = level.reshape(len(level) // 2, 2, len(level) // 2, 2, 3).mean(axis=(1, 3))
    log = np.array([logs], np.int32)
    return Atlas(
        texels=np.concatenate(texels), taps=np.array([2], np.int32), offset=np.array([offset]), log_width=log,
        log_height=log, levels=np.array([len(logs)], np.int32),
    )  # fmt: skip


ATLAS = plain_atlas(np.full((8, 8, 3), 200))


def render(polygons, atlas: Atlas = ATLAS):
    """Paint on black, without haze."""
    canvas = blank_canvas(WIDTH, HEIGHT, (0, 0, 0))
    counts = paint(canvas, polygons, world_to_cam=np.eye(4), camera=CAMERA, atlas=atlas, haze=(0, 0, 0), haze_m=1e9)
    return canvas, counts


def picture_polygon(corners_xy: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Corners in 3-D that project to given pixels at given depths."""
    ray = (corners_xy - CAMERA[2:]) / CAMERA[:2]
    return np.column_stack([ray * z[:, None], z])


@pytest.mark.parametrize("seed", range(6))
def test_edges_cover_as_much_as_a_supersampled_polygon(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 5)) + rng.uniform(0, 1)
    corners = (49.5, 39.5) + 28 * np.column_stack([np.cos(angle), np.sin(angle)])
    canvas, _ = render(make_polygons([picture_polygon(corners, np.full(5, 4.0))], colour=(255, 255, 255)))
    fine = (np.arange(WIDTH * 8) + 0.5) / 8 - 0.5, (np.arange(HEIGHT * 8) + 0.5) / 8 - 0.5
    x, y = np.meshgrid(*fine)
    after = np.roll(corners, -1, axis=0)
    inside = np.ones_like(x, bool)
    for (ax, ay), (bx, by) in zip(corners, after, strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0
    truth = inside.reshape(HEIGHT, 8, WIDTH, 8).mean(axis=(1, 3))
    error = np.abs(canvas.rgb[..., 0] / 255 - truth)
    assert error.mean() < 0.003
    assert np.quantile(error, 0.999) < 0.3


def test_depth_is_that_of_the_plane_and_the_nearer_polygon_wins() -> None:
    square = np.array([(10, 10), (90, 10), (90, 70), (10, 70)], float)
    slanted = picture_polygon(square, np.array([4.0, 8.0, 8.0, 4.0]))
    near = picture_polygon(square[[0, 1, 2, 3]] * 0.5 + 20, np.full(4, 2.0))
    canvas, _ = render(make_polygons([slanted, near], colour=np.array([(255, 0, 0), (0, 255, 0)])))
    normal = np.cross(slanted[1] - slanted[0], slanted[2] - slanted[0])
    ray = np.array([(80 - CAMERA[2]) / 100, (20 - CAMERA[3]) / 100, 1.0])
    expected = (normal @ ray) / (normal @ slanted[0])
    assert canvas.inverse_depth[20, 80] == pytest.approx(expected, rel=1e-5)
    assert tuple(canvas.rgb[20, 80]) == (255, 0, 0)
    assert tuple(canvas.rgb[40, 45]) == (0, 255, 0)
    reversed_order, _ = render(make_polygons([near, slanted], colour=np.array([(0, 255, 0), (255, 0, 0)])))
    assert tuple(reversed_order.rgb[40, 45]) == (0, 255, 0)


def test_a_texture_lies_where_its_gradient_says() -> None:
    picture = np.zeros((64, 64, 3))
    picture[..., 0] = np.arange(64)[None] * 4
    picture[..., 1] = np.arange(64)[:, None] * 4
    square = np.array([(5, 5), (95, 5), (95, 75), (5, 75)], float)
    wall = picture_polygon(square, np.full(4, 2.0))
    per_m = 24.0  # Texels per metre: about two pixels per texel.
    gradient = np.array([[per_m, 0, 0, 32.0], [0, per_m, 0, 32.0]])
    canvas, _ = render(make_polygons([wall], texture=0, gradient=gradient), plain_atlas(picture))
    for x, y in ((30, 20), (50, 40), (70, 60)):
        u = (x - CAMERA[2]) / 100 * 2.0 * per_m + 32
        v = (y - CAMERA[3]) / 100 * 2.0 * per_m + 32
        assert canvas.rgb[y, x, 0] == pytest.approx((u - 0.5) * 4, abs=1.5)
        assert canvas.rgb[y, x, 1] == pytest.approx((v - 0.5) * 4, abs=1.5)


def test_a_minified_texture_turns_into_its_mean() -> None:
    index = np.arange(64) // 4  # Checks of 4 texels, under pixels of 16: only a deep level is their mean.
    checks = np.repeat((index[:, None] + index[None]) % 2 * 255.0, 3).reshape(64, 64, 3)
    square = np.array([(5, 5), (95, 5), (95, 75), (5, 75)], float)
    gradient = np.array([[783.0, 0, 0, 0], [0, 791.0, 0, 0]])  # No whole number of checks a pixel.
    canvas, _ = render(
        make_polygons([picture_polygon(square, np.full(4, 2.0))], texture=0, gradient=gradient), plain_atlas(checks)
    )
    inner = canvas.rgb[10:70, 10:90].astype(float)
    assert inner.std() < 3
    assert inner.mean() == pytest.approx(128, abs=3)


def test_what_reaches_behind_the_camera_is_cut_at_the_near_plane() -> None:
    floor = np.array([(-50, 1.0, -50), (50, 1.0, -50), (50, 1.0, 50), (-50, 1.0, 50)])
    canvas, _ = render(make_polygons([floor], colour=(255, 255, 255)))
    assert (canvas.rgb[45:] == 255).all()
    assert (canvas.rgb[:38] == 0).all()
    np.testing.assert_allclose(1 / canvas.inverse_depth[70, 50], 100 / (70 - CAMERA[3]), rtol=1e-5)


def test_owners_and_counts() -> None:
    square = np.array([(10, 10), (60, 10), (60, 60), (10, 60)], float)
    far, near = picture_polygon(square, np.full(4, 6.0)), picture_polygon(square + 20, np.full(4, 3.0))
    both = make_polygons([far], owner=1), make_polygons([near], owner=2)
    first, _ = render(both[0])
    canvas, (drawn, rejected) = render(join(list(both)))
    assert drawn[1] == (first.owner == 1).sum()
    assert (canvas.owner == 1).sum() < drawn[1]
    assert drawn[2] == (canvas.owner == 2).sum()
    assert rejected.sum() == 0
    _, (drawn, rejected) = render(join(list(both)[::-1]))
    assert rejected[1] > 0

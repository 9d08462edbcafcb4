"""Ego video: true parallax and none where there is none, seams and poles, the released look, the reference renderer."""

import warnings

import cv2
import numpy as np
import pytest
from conftest import real_data_folder
from scipy.spatial.transform import Rotation

from labeling import ego_reference
from labeling.camera import Intrinsics, Trajectory, prior_intrinsics, rebased_trajectory, rigid
from labeling.ego_dust import NEAR_M, REACH_M, draw_specks, fill_cube, specks_in_view
from labeling.ego_sphere import Lens, _texel, draw_sphere, world_raster
from labeling.ego_video import ego_frames
from labeling.errors import ConfigError, TrajectoryError

WIDTH, HEIGHT = 264, 176
CAMERA = prior_intrinsics(1056, 704)


def _sphere_coordinates(cam_to_world: np.ndarray, x: np.ndarray, y: np.ndarray, *, lens: Lens) -> np.ndarray:
    """Exact (azimuth + 180) / 360 and polar angle / 180 where pixels look, each in [0, 1].

    Args:
        cam_to_world: (4, 4) float64, relative to the first camera.
        x: (N,) pixel columns.
        y: (N,) pixel rows.
        lens: the camera's.

    Returns:
        (N, 2) float64.
    """
    view, one = np.array([lens.fx, lens.fy, lens.cx, lens.cy]), np.ones(2)
    motion = np.ascontiguousarray(cam_to_world, dtype=np.float64)
    return np.array([_texel(a, b, motion, view, one) for a, b in zip(x, y, strict=True)]).reshape(-1, 2) + 0.5


def _trajectory(*, forward_m=0.0, yaw_deg=0.0, pitch_deg=0.0, side_m=0.0, frames: int = 6) -> Trajectory:
    """A steady motion that adds up to these values."""
    share = np.linspace(0, 1, frames)[:, None]
    rotation = Rotation.from_euler("yx", share * [yaw_deg, pitch_deg], degrees=True).as_matrix()
    return rebased_trajectory(np.arange(frames) / 24, rigid(rotation, share * [side_m, 0.0, forward_m]))


def _turned(yaw_deg: float, pitch_deg: float = 0.0, position=(0.0, 0.0, 0.0)) -> np.ndarray:
    return rigid(Rotation.from_euler("yx", [yaw_deg, pitch_deg], degrees=True).as_matrix(), np.array(position))


def _frames(trajectory: Trajectory, **kwargs) -> list[np.ndarray]:
    return list(ego_frames(trajectory, **{"width": WIDTH, "height": HEIGHT, **kwargs}))


def _lens(camera: Intrinsics) -> Lens:
    return Lens(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)


def _sphere(motion: np.ndarray, camera: Intrinsics) -> np.ndarray:
    return draw_sphere(
        motion, raster=world_raster(camera), lens=_lens(camera), width=camera.width, height=camera.height
    )


# The world style


def test_one_frame_for_each_of_the_trajectorys_poses():
    for style in ("world", "released"):
        for frames in (1, 2, 5):
            pictures = _frames(_trajectory(forward_m=1, frames=frames), style=style)
            assert len(pictures) == frames
            assert all(one.shape == (HEIGHT, WIDTH, 3) and one.dtype == np.uint8 for one in pictures)


def test_standing_still_changes_nothing():
    pictures = _frames(_trajectory())
    assert all(np.array_equal(one, pictures[0]) for one in pictures[1:])


def test_the_same_seed_gives_the_same_bytes_and_another_seed_other_dust():
    drive = _trajectory(forward_m=3, yaw_deg=10)
    one, same, other = _frames(drive, seed=5), _frames(drive, seed=5), _frames(drive, seed=6)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(one, same, strict=True))
    changed = (one[0] != other[0]).any(axis=2).mean()
    assert 0.005 < changed < 0.3, "dust moves, the sphere does not"


def _followed(cube, before: np.ndarray, after: np.ndarray):
    """Specks seen from both cameras: pixels (n, 2) before and after, depth before."""
    one, two = (specks_in_view(cube, motion, intrinsics=CAMERA) for motion in (before, after))
    _, i, j = np.intersect1d(one.index, two.index, return_indices=True)
    return np.column_stack([one.x, one.y])[i], np.column_stack([two.x, two.y])[j], one.depth_m[i]


@pytest.mark.parametrize("yaw_deg,pitch_deg", [(8, 0), (0, 5), (-6, 4), (-20, -3)])
def test_a_pure_turn_moves_sphere_and_dust_alike_without_parallax(yaw_deg, pitch_deg):
    start, turned = _turned(30), _turned(30 + yaw_deg, pitch_deg)
    before, after, depth = _followed(fill_cube(CAMERA, seed=1), start, turned)
    # A turn is one homography for all that is seen, whatever its distance.
    homography = CAMERA.matrix @ turned[:3, :3].T @ start[:3, :3] @ np.linalg.inv(CAMERA.matrix)
    expected = np.column_stack([before, np.ones(len(before))]) @ homography.T
    assert len(before) > 50 and depth.max() > 4 * depth.min()
    assert np.abs(expected[:, :2] / expected[:, 2:] - after).max() < 1e-6
    inside = expected[:, :2] / expected[:, 2:]
    here = _sphere_coordinates(start, *before.T, lens=_lens(CAMERA))
    there = _sphere_coordinates(turned, *inside.T, lens=_lens(CAMERA))
    assert np.abs(here - there).max() < 1e-9, "and the sphere with it"


def test_a_turn_on_the_spot_warps_the_whole_picture_by_that_homography():
    camera = CAMERA.resized(528, 352)
    one, two = (_sphere(_turned(yaw), camera) for yaw in (0, 5))
    homography = camera.matrix @ _turned(5)[:3, :3].T @ np.linalg.inv(camera.matrix)
    warped = cv2.warpPerspective(one, homography, (528, 352))
    seen = cv2.warpPerspective(np.full((352, 528), 255, np.uint8), homography, (528, 352)) == 255
    assert np.abs(warped.astype(int) - two)[seen].mean() < 1.5


def test_a_translation_moves_near_dust_more_than_far_dust_and_hardly_the_sphere():
    cube, step = fill_cube(CAMERA, seed=2), np.array([0.3, 0.0, 0.0])
    start = _turned(0)
    before, after, depth = _followed(cube, start, _turned(0, position=step))
    moved = np.hypot(*(after - before).T)
    assert np.abs(moved - CAMERA.fx * step[0] / depth).max() < 1e-6, "sideways: f * step / depth, exactly"
    here = _sphere_coordinates(start, *before.T, lens=_lens(CAMERA))
    there = _sphere_coordinates(_turned(0, position=step), *before.T, lens=_lens(CAMERA))
    sphere_pixels = np.abs(here - there).max() * 2 * np.pi * CAMERA.fx
    assert sphere_pixels < 2 < moved.min() * 2


def test_driving_ahead_spreads_the_dust_from_the_point_ahead():
    before, after, _ = _followed(fill_cube(CAMERA, seed=3), _turned(0), _turned(0, position=(0, 0, 0.5)))
    centre = [CAMERA.cx, CAMERA.cy]
    assert (np.hypot(*(after - centre).T) > np.hypot(*(before - centre).T)).all()
    across = np.cross(before - centre, after - before)
    assert np.abs(across).max() < 1e-6 * np.abs(before).max() ** 2


@pytest.mark.parametrize("width,height,focal", [(1056, 704, 1056.0), (768, 512, 600.0), (1056, 704, 2000.0)])
def test_300_to_800_specks_are_in_view_wherever_the_camera_is(width, height, focal):
    camera = Intrinsics(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, source="given")
    cube = fill_cube(camera, seed=0)
    for place in ((0, 0, 0), (3.3, -1, 140), (-77, 2, 15)):
        for yaw, pitch in ((0, 0), (45, 20), (200, -35)):
            specks = specks_in_view(cube, _turned(yaw, pitch, place), intrinsics=camera)
            assert 300 <= len(specks.x) <= 800
            assert specks.depth_m.min() >= NEAR_M and specks.depth_m.max() <= REACH_M
            assert (np.diff(specks.depth_m) <= 0).all(), "far ones first"


def test_dust_is_fixed_in_the_world_but_for_the_wrap():
    cube = fill_cube(CAMERA, seed=4)
    side = 2 * REACH_M
    here, there = (
        specks_in_view(cube, _turned(0, position=p), intrinsics=CAMERA) for p in ((0, 0, 0), (0, side, -side))
    )
    assert np.array_equal(here.index, there.index) and np.allclose(here.x, there.x)


def test_specks_fade_where_the_cube_repeats_and_shrink_with_distance():
    specks = specks_in_view(fill_cube(CAMERA, seed=0), _turned(0), intrinsics=CAMERA)
    assert specks.opacity[specks.depth_m > 0.99 * REACH_M].max(initial=0) < 0.1
    assert specks.opacity[specks.depth_m < 8].min() == 1
    assert (np.diff(specks.radius) >= 0).all(), "far to near"


def test_specks_are_discs_of_their_radius():
    specks = specks_in_view(fill_cube(CAMERA, seed=0), _turned(0), intrinsics=CAMERA)
    picture = np.zeros((704, 1056, 3), np.uint8)
    draw_specks(picture, specks)
    area = picture[..., 0].astype(float).sum() / 255
    assert area == pytest.approx((np.pi * specks.radius**2 * specks.opacity).sum(), rel=0.06)


# The sphere


def _exact_sphere(motion: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Every pixel's own look-up in the raster as a picture, bilinear, the seam wrapped."""
    raster = world_raster(camera)
    texels = np.pad(raster.picture().astype(np.float64), ((1, 1), (0, 0), (0, 0)), mode="edge")
    texels = np.pad(texels, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = rays @ motion[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    position = motion[:3, 3]
    along = rays @ position
    points = position + rays * (np.sqrt(along**2 + 500.0**2 - position @ position) - along)[..., None]
    u = (np.arctan2(-points[..., 2], points[..., 0]) / (2 * np.pi) + 0.5) * (texels.shape[1] - 2) + 0.5
    v = np.arccos(np.clip(points[..., 1] / 500, -1, 1)) / np.pi * (texels.shape[0] - 2) + 0.5
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = (u - i)[..., None], (v - j)[..., None]
    blend = (texels[j, i] * (1 - a) + texels[j, i + 1] * a) * (1 - b)
    blend += (texels[j + 1, i] * (1 - a) + texels[j + 1, i + 1] * a) * b
    return np.floor(blend + 0.5).astype(np.uint8)


VIEWS = {
    "ahead": _turned(0),
    "seam": _turned(-90),
    "seam, tilted, far from the centre": _turned(-88, 25, (30.0, -2.0, 120.0)),
    "upper pole": _turned(10, 89),
    "lower pole": _turned(100, -86, (3.0, 1.0, 40.0)),
    "behind": _turned(183, 3, (0.0, 0.0, 150.0)),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("width,height", [(528, 352), (101, 67)])
def test_the_sphere_is_that_of_every_pixels_own_look_up(view, width, height):
    camera = CAMERA.resized(width, height)
    drawn, exact = _sphere(VIEWS[view], camera), _exact_sphere(VIEWS[view], camera)
    difference = np.abs(drawn.astype(int) - exact)
    assert difference.mean() < 0.2
    assert difference.max() <= 40, "at most a seventh of a texel off, seam and poles included"


def test_checks_are_64_around_and_32_down_and_every_other_is_black():
    camera = CAMERA.resized(528, 352)
    raster = world_raster(camera)
    assert raster.palette.shape == (64, 32, 3)
    i, j = np.indices((64, 32))
    assert (raster.palette.any(axis=2) == ((i + j) % 2 == 1)).all()
    picture = raster.picture()
    assert picture.shape[1] == 2 * picture.shape[0] and picture.shape[1] % 64 == 0


def test_a_camera_outside_the_sphere_is_refused_with_advice():
    with pytest.raises(TrajectoryError, match="render clips"):
        _frames(_trajectory(forward_m=600))
    with pytest.raises(TrajectoryError, match="render clips"):
        _frames(_trajectory(forward_m=700), style="released")


def test_intrinsics_of_any_size_are_resized_to_the_picture():
    small, large = (prior_intrinsics(1056, 704).resized(w, h) for w, h in ((WIDTH, HEIGHT), (2112, 1408)))
    drive = _trajectory(forward_m=1)
    pictures = [_frames(drive, intrinsics=camera)[1] for camera in (small, large, None)]
    assert np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2]), "the prior is of a whole picture"


def test_a_longer_lens_sees_fewer_checks():
    narrow, wide = (
        Intrinsics(width=WIDTH, height=HEIGHT, fx=f, fy=f, cx=132, cy=88, source="given") for f in (1000, 150)
    )
    colours = [len(np.unique(_frames(_trajectory(), intrinsics=c)[0].reshape(-1, 3), axis=0)) for c in (narrow, wide)]
    assert colours[0] < colours[1]


# The released style


def _released_by_the_book(cam_to_world: np.ndarray, width: int, height: int) -> list[np.ndarray]:
    """The released renderer as the design describes it, line by line, with torch's own sampling."""
    import torch

    relative = np.linalg.inv(cam_to_world[0]) @ cam_to_world
    focal, centre = float(max(width, height)), (width / 2, height / 2)
    palette = np.random.default_rng(42).integers(0, 256, (65, 33, 3), np.uint8)
    i = np.linspace(0, 64, 2 * width).astype(int)[None, :]
    j = np.linspace(0, 32, 2 * height).astype(int)[:, None]
    raster = palette[i, j].copy()
    raster[(i + j) % 2 == 0] = 0
    texture = torch.tensor(raster, dtype=torch.float64).permute(2, 0, 1)[None]
    rng = np.random.default_rng(42)
    points = rng.uniform([0, 0], [width, height], (500, 2))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(x - centre[0]) / focal, (y - centre[1]) / focal, np.ones(x.shape)], axis=-1)
    frames = []
    for t in range(len(relative) - 1):
        rotation, position = relative[t, :3, :3], relative[t, :3, 3]
        unit = rays @ rotation.T
        unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
        along = unit @ position
        hit = position + unit * (np.sqrt(along**2 - position @ position + 500.0**2) - along)[..., None]
        hit = np.stack([hit[..., 0], -hit[..., 2], hit[..., 1]], axis=-1)
        phi = np.arctan2(hit[..., 1], hit[..., 0])
        theta = np.arccos(hit[..., 2] / np.linalg.norm(hit, axis=-1))
        grid = torch.tensor(np.stack([phi / np.pi, theta / np.pi * 2 - 1], axis=-1))[None]
        sampled = torch.nn.functional.grid_sample(
            texture, grid, mode="bilinear", padding_mode="border", align_corners=False
        )
        picture = np.ascontiguousarray(sampled[0].permute(1, 2, 0).numpy().astype(np.uint8))
        step = np.linalg.inv(relative[t + 1]) @ relative[t]
        plane = 15.0 * rays @ step[:3, :3].T + step[:3, 3]
        flow = plane[..., :2] / plane[..., 2:] * focal + centre - np.stack([x, y], axis=-1)
        for number in range(500):
            here = points[number]
            there = here + flow[int(here[1]), int(here[0])]
            start, end = ((int(p[0]), int(p[1])) for p in (here, there))
            cv2.line(picture, start, end, (255, 255, 200), 5, cv2.LINE_AA)
            if not (0 <= there[0] < width and 0 <= there[1] < height):
                there = rng.uniform([0, 0], [width, height])
            points[number] = there
        frames.append(picture)
    return [*frames, frames[-1]]


@pytest.mark.parametrize(
    "drive", [{"forward_m": 5.0, "yaw_deg": 8.0}, {"side_m": 2.0, "pitch_deg": 4.0}, {"forward_m": -3.0}], ids=str
)
@pytest.mark.parametrize("width,height", [(132, 88), (90, 120)])
def test_the_released_style_is_the_designs_description(drive, width, height):
    pytest.importorskip("torch", reason="torch is not installed; it samples the reference")
    trajectory = _trajectory(frames=8, **drive)
    drawn = _frames(trajectory, width=width, height=height, style="released")
    expected = _released_by_the_book(trajectory.cam_to_world, width, height)
    for one, other in zip(drawn, expected, strict=True):
        assert np.abs(one.astype(int) - other).mean() < 1.0


def test_the_released_style_equals_its_golden_pictures():
    folder = real_data_folder().parent / "golden" / "ego_released"
    if not folder.is_dir():
        pytest.skip(f"no golden pictures of the released style: {folder} is not there")
    poses = np.load(folder / "cam_to_world.npy")
    drawn = _frames(rebased_trajectory(np.arange(len(poses)) / 24, poses), style="released")
    paths = sorted(folder.glob("frame_*.png"))
    assert len(drawn) == 25 and len(paths) == 6
    for path in paths:
        golden = cv2.imread(str(path))
        assert golden is not None
        assert np.abs(drawn[int(path.stem[-2:])].astype(int) - golden[..., ::-1]).mean() < 1.0, path.name


def test_the_released_style_shows_its_last_frame_twice():
    drawn = _frames(_trajectory(forward_m=3, frames=4), style="released")
    assert np.array_equal(drawn[-1], drawn[-2]) and not np.array_equal(drawn[0], drawn[1])


def test_released_lines_survive_a_plane_behind_the_camera():
    for drawn in _frames(_trajectory(forward_m=60, yaw_deg=170, frames=3), style="released"):
        assert drawn.any()


# The reference renderer


@pytest.fixture(scope="module")
def opengl() -> None:
    """VTK can draw here; the test skips with the reason where it cannot."""
    missing = ego_reference.missing_library()
    if missing is not None:
        pytest.skip(missing)


def test_the_reference_renderer_agrees_away_from_the_edges_of_checks(opengl):
    camera = Intrinsics(width=384, height=256, fx=320, fy=344, cx=176, cy=136, source="given")
    drive = _trajectory(forward_m=4, yaw_deg=-70, pitch_deg=6, frames=2)
    size = {"width": 384, "height": 256, "intrinsics": camera}
    for motion, drawn, reference in zip(
        drive.cam_to_world, _frames(drive, **size), _frames(drive, **size, renderer="pyvista"), strict=True
    ):
        sphere = _sphere(motion, camera)
        flat = cv2.dilate(sphere, np.ones((5, 5), np.uint8)) == cv2.erode(sphere, np.ones((5, 5), np.uint8))
        difference = np.abs(drawn.astype(int) - reference)[flat.all(axis=2)]
        assert flat.all(axis=2).mean() > 0.6
        assert difference.mean() <= 1.0


def test_without_opengl_the_job_goes_on_and_says_what_to_install(monkeypatch):
    monkeypatch.setattr(ego_reference, "_PROBE", "import os; os.abort()")
    ego_reference.missing_library.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="libosmesa6"):
            stand_in = _frames(_trajectory(forward_m=1), renderer="pyvista")
        with pytest.raises(ConfigError, match="libosmesa6"):
            ego_reference.reference_frames(_trajectory(), intrinsics=CAMERA, seed=0)
    finally:
        ego_reference.missing_library.cache_clear()
    assert all(np.array_equal(a, b) for a, b in zip(stand_in, _frames(_trajectory(forward_m=1)), strict=True))


def test_the_default_renderer_never_asks_for_opengl(monkeypatch):
    monkeypatch.setattr(ego_reference, "missing_library", lambda: pytest.fail("probed for nothing"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _frames(_trajectory())


@pytest.mark.parametrize(
    "wrong,message",
    [
        ({"width": 0}, "positive size"),
        ({"height": -4}, "positive size"),
        ({"style": "released", "renderer": "pyvista"}, "only the style 'world'"),
    ],
    ids=str,
)
def test_what_cannot_be_drawn_is_refused_at_once(wrong, message):
    with pytest.raises(ConfigError, match=message):
        ego_frames(_trajectory(), **{"width": WIDTH, "height": HEIGHT, **wrong})

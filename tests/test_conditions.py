"""Picture conditions: the same seed and frame give the same bytes, and each does what its name says."""

import numpy as np
import pytest

from dataset.conditions import CONDITIONS, Condition, apply_condition, compress_frames
from labeling.errors import ConfigError


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """A smooth picture with some texture, odd sides."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:121, 0:201]
    base = 110 + 50 * np.sin(x / 17) + 40 * np.cos(y / 11)
    return np.clip(base[..., None] + rng.normal(0, 6, (121, 201, 3)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", CONDITIONS)
def test_same_seed_and_frame_same_bytes(name: Condition, picture: np.ndarray) -> None:
    before = picture.copy()
    one = apply_condition(picture, name, seed=4, frame=7)
    two = apply_condition(picture, name, seed=4, frame=7)
    assert one.tobytes() == two.tobytes()
    assert one.shape == picture.shape and one.dtype == np.uint8
    np.testing.assert_array_equal(picture, before)
    if name != "clean":
        assert (one != picture).any()


@pytest.mark.parametrize("name", ["rain", "noise", "night", "dusk"])
def test_noise_and_rain_differ_from_frame_to_frame(name: Condition, picture: np.ndarray) -> None:
    one = apply_condition(picture, name, seed=4, frame=7)
    assert (one != apply_condition(picture, name, seed=4, frame=8)).any()
    assert (one != apply_condition(picture, name, seed=5, frame=7)).any()


def test_gains_are_as_stated(picture: np.ndarray) -> None:
    mean = picture.mean()
    assert apply_condition(picture, "dusk", seed=0, frame=0).mean() == pytest.approx(0.4 * mean, rel=0.03)
    upper = slice(0, 50)
    night = apply_condition(picture, "night", seed=0, frame=0)[upper]
    assert night.mean() == pytest.approx(0.15 * picture[upper].mean(), abs=2)
    full = apply_condition(picture, "brightness_ramp", seed=0, frame=120)
    assert full.mean() == pytest.approx(np.clip(picture * 1.5, 0, 255).mean(), rel=0.01)


def test_noise_has_its_sigma(picture: np.ndarray) -> None:
    flat = np.full_like(picture, 128)
    assert apply_condition(flat, "noise", seed=1, frame=1, amount=6).std() == pytest.approx(6, rel=0.05)


@pytest.mark.parametrize("length", [1, 4, 5, 15])
def test_motion_blur_spreads_a_point_over_its_length(length: int) -> None:
    point = np.zeros((9, 41, 3), np.uint8)
    point[4, 20] = 240
    blurred = apply_condition(point, "motion_blur", seed=0, frame=0, amount=length)
    lit = blurred[4, :, 0] > 0
    assert length <= lit.sum() <= length + 1
    assert blurred.sum() == pytest.approx(point.sum(), rel=0.1)


def test_what_stands_in_the_way_covers_its_share(picture: np.ndarray) -> None:
    for name in ("bonnet", "overlay"):
        changed = (apply_condition(picture, name, seed=0, frame=3) != picture).any(axis=2)
        assert changed.mean() == pytest.approx(0.15, abs=0.02)
    boxed = apply_condition(picture, "letterbox", seed=0, frame=0)
    assert (boxed[:14] == 0).all() and (boxed[-14:] == 0).all() and (boxed[16:-16] == picture[16:-16]).all()


def test_the_wiper_passes_each_second_and_rests_between(picture: np.ndarray) -> None:
    dark = [(apply_condition(picture, "wiper", seed=0, frame=k) != picture).any(axis=2).mean() for k in range(48)]
    assert dark[:24] == dark[24:]
    assert max(dark) > 0.01 and dark[23] == 0


def test_a_stronger_rate_factor_loses_more(picture: np.ndarray) -> None:
    def loss(crf: int) -> float:
        return float(np.abs(apply_condition(picture, "h264", seed=0, frame=0, amount=crf).astype(int) - picture).mean())

    assert loss(15) < loss(30) < loss(45)
    frames = [picture[:120, :200]] * 5
    assert len(list(compress_frames(frames, crf=40))) == 5


def test_bad_input_is_refused(picture: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="snow"):
        apply_condition(picture, "snow", seed=0, frame=0)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="uint8"):
        apply_condition(picture.astype(float), "dusk", seed=0, frame=0)
    with pytest.raises(ConfigError, match="even"):
        list(compress_frames([picture], crf=30))

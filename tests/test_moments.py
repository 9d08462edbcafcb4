"""Which frames show a new picture, and what time it is in each."""

from fractions import Fraction

import numpy as np
import pytest
from moving_card import MovingCard

from labeling.moments import Moments, same_picture, usual_gap


def moments_of(new: list[bool]) -> Moments:
    found = Moments()
    for frame, shows_new in enumerate(new):
        if shows_new:
            found.new(frame)
        else:
            found.again()
    return found


@pytest.mark.parametrize("fps", [24, 20, 17, 15, 12, 10, 8])
def test_a_clock_goes_with_the_grid_whatever_the_source(fps: int) -> None:
    """Sources of 17 and 20 fps show some pictures for one frame of the grid and some for two: none of them froze."""
    of = [int(Fraction(frame * fps, 24)) for frame in range(96)]
    found = moments_of([frame == 0 or of[frame] != of[frame - 1] for frame in range(96)])
    steps, gaps = np.diff(found.clocks), np.diff(found.frames)
    # The first pictures of a source do not yet tell how long one usually lasts.
    np.testing.assert_array_equal(steps[2:], gaps[2:])
    assert found.latest == of[-1] and found.shown == of


def test_nothing_grows_old_in_what_a_camera_froze() -> None:
    found = moments_of([True] * 20 + [False] * 30 + [True] * 10)
    assert found.clocks == list(range(30)) and found.pace == 1
    assert found.shown == [*range(20), *[19] * 30, *range(20, 30)]


@pytest.mark.parametrize(
    ("frames", "gap"), [([0], 1), ([0, 9], 1), ([0, 9, 10], 1), ([0, 2, 4, 6], 2), ([0, 2, 4, 30], 2)]
)
def test_the_usual_gap(frames: list[int], gap: int) -> None:
    assert usual_gap(frames) == gap


def test_what_a_decoder_changes_is_the_same_picture_and_noise_is_not() -> None:
    picture = MovingCard().render(3)
    rng = np.random.default_rng(0)
    decoded = np.clip(picture + rng.integers(-2, 3, picture.shape), 0, 255).astype(np.uint8)
    noisy = np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
    moved, touched = MovingCard().render(4), picture.copy()
    touched[70:80, 100:110] = 0
    assert not same_picture(picture, touched), "a change between the rows that are compared first"
    assert same_picture(picture, picture.copy()) and same_picture(picture, decoded)
    assert not same_picture(picture, noisy) and not same_picture(picture, moved)
    assert not same_picture(picture, picture[:-2])
    grey, other = picture[..., 0], moved[..., 0]
    assert same_picture(grey, grey.copy()) and not same_picture(grey, other)

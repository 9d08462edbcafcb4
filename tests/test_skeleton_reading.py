"""Reading skeletons back: what is recovered, what is said of the rest, and its compiled parts against plain ones."""

import numpy as np
from skeleton_fixtures import busy_street, car, lane

from labeling.skeleton_evidence import explained_pixels, line_evidence, matching_pixels, merged_places, on_dots
from labeling.skeleton_raster import Capsules, fill_capsules
from labeling.skeleton_reading import read_skeletons
from labeling.skeleton_video import draw_skeletons

STILL = np.zeros((1, 2))


def drawn(labels):
    return draw_skeletons(labels, width=768, height=512)


def right_points(found, truth):
    """(cars, cars) how many points of each found car lie within two pixels of each true one's."""
    return np.array(
        [
            [
                (np.hypot(*(one.points - other.points)[:, :2].T) <= 2)[one.present & other.present].sum()
                for other in truth
            ]
            for one in found
        ]
    )


def test_a_car_alone_is_explained_to_the_last_line():
    reading = read_skeletons(drawn([car(ahead_m=11, heading_deg=35), lane(right_m=-6)]))
    assert reading.unexplained_share < 0.01 and reading.left_out == 0
    (found,) = reading.cars
    assert found.score > 0.8, "the share of its own drawing that is there"


def test_of_two_cars_that_overlap_most_comes_back_and_little_is_wrong():
    truth = [car(ahead_m=12), car(right_m=1.0, ahead_m=18, heading_deg=20, track_id=1)]
    reading = read_skeletons(drawn(truth))
    right = right_points(reading.cars, truth)
    assert len(reading.cars) == 2 and sorted(right.argmax(axis=1)) == [0, 1]
    assert right.max(axis=1).sum() >= 0.9 * sum(one.present.sum() for one in truth)
    assert right.max(axis=1).sum() >= 0.97 * sum(one.present.sum() for one in reading.cars)
    assert 0.01 < reading.unexplained_share < 0.08


def test_a_pile_of_cars_says_how_much_of_it_was_not_read():
    truth = [one for one in busy_street(cars=20, people=0, schema="car24") if one.category == "car"]
    reading = read_skeletons(drawn(truth), schema="car24")
    assert reading.left_out > 0 and reading.unexplained_share > 0.1
    right = right_points(reading.cars, truth).max(axis=1).sum()
    assert right >= 0.8 * sum(one.present.sum() for one in reading.cars), "what is given is mostly right all the same"


def test_noise_is_not_looked_at_to_the_end():
    rng = np.random.default_rng(1)
    blocks = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 255, 255], [0, 0, 0]], np.uint8)
    picture = blocks[rng.integers(0, 6, (128, 192))].repeat(4, axis=0).repeat(4, axis=1)
    reading = read_skeletons(picture, schema="car24")
    assert reading.left_out > 0 and reading.unexplained_share > 0.5


def test_an_empty_picture_leaves_nothing_unexplained():
    reading = read_skeletons(np.zeros((64, 96, 3), np.uint8))
    assert reading.cars == () and reading.unexplained_share == 0 and reading.left_out == 0


def test_places_that_agree_become_one():
    means, votes = merged_places(np.array([[0.0, 0], [10, 10], [1, 0], [10, 11], [0.5, 0.5], [40, 0]]), 2.0)
    assert votes.tolist() == [3, 2, 1]
    assert np.allclose(means, [[0.5, 1 / 6], [10, 10.5], [40, 0]])
    assert merged_places(np.zeros((0, 2)), 2.0)[0].shape == (0, 2)


def test_a_place_moves_onto_its_dot_and_says_how_much_of_it_is_seen():
    parts = np.full((40, 40), -1, np.int32)
    y, x = np.mgrid[:40, :40]
    parts[np.hypot(x - 20, y - 15) <= 2.5] = 7
    places, seen = on_dots(parts, 7, np.array([[21.2, 14.1], [5.0, 5.0], [-3.0, 90.0]]), 2.5)
    assert np.hypot(*(places[0] - [20, 15])) < 0.3 and seen[0] > 0.9
    assert np.array_equal(places[1:], [[5, 5], [-3, 90]]) and not seen[1:].any(), "no dot, no move, nor outside"


def test_a_line_is_told_from_one_that_runs_on():
    hue = np.zeros((30, 100), np.uint8)
    hue[14:17, 10:81] = 1
    ends = np.array([[10.0, 15], [40, 15]]), np.array([[80.0, 15], [80, 25]])
    share, lit = line_evidence(hue, hue, *ends, 1.5)
    assert share[0, 0] == 1 and lit[0, 0] == 1
    assert 0 < share[1, 0] <= 0.25, "from the middle of the line: it goes on backwards"
    assert lit[0, 1] < 0.5


def test_matching_pixels_are_those_of_the_rasteriser():
    rng = np.random.default_rng(4)
    ends, radii = rng.uniform(-5, 45, (12, 4)), rng.uniform(0.6, 3, 12)
    numbers = rng.integers(0, 9, 12)
    picture = np.zeros((40, 40, 3), np.uint8)
    fill_capsules(
        picture, Capsules(ends=ends, radii=radii, colours=np.repeat(numbers + 1, 3).reshape(-1, 3).astype("u1"))
    )
    parts = picture[..., 0].astype(np.int32) - 1
    nowhere, corner = np.zeros((12, 2), bool), np.zeros(2)
    assert matching_pixels(parts, corner, ends, radii, numbers, STILL, nowhere).tolist() == [1600]
    crop = parts[10:30, 5:35]
    assert matching_pixels(crop, np.array([5.0, 10.0]), ends, radii, numbers, STILL, nowhere).tolist() == [600]
    shifted = ends.copy()
    shifted[11, 2:] += (4, -3)
    moved = nowhere.copy()
    moved[11, 1] = True
    steps = np.array([[0.0, 0.0], [-4.0, 3.0]])
    counts = matching_pixels(parts, corner, shifted, radii, numbers, steps, moved)
    assert counts[1] == 1600 > counts[0]


def test_a_line_half_a_pixel_off_is_explained():
    parts, there = np.full((9, 20), -1, np.int32), np.full((9, 20), -1, np.int32)
    parts[4], there[5] = 3, 3
    assert np.array_equal(explained_pixels(parts, there), parts == 3)
    there[:] = 2
    assert not explained_pixels(parts, there).any()

"""Skeletons: what is drawn where and in which colour, the mask of lit cells, and reading a drawing back."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import hsv_to_rgb
from skeleton_fixtures import busy_street, car, label, lane, person

from labeling.errors import ConfigError, DataError
from labeling.schemas import facts, keypoint_schema
from labeling.skeleton_raster import Capsules, fill_capsules
from labeling.skeleton_reading import skeletons_from_frame
from labeling.skeleton_video import (
    SkeletonStyle,
    complete_lane,
    dot_edges,
    draw_skeletons,
    edge_colours,
    lit_cells,
    openpose_body,
    skeleton_capsules,
)

GOLDEN = Path(__file__).with_name("golden")


def _few_points(schema: str, places: dict[int, tuple[float, ...]]):
    """A label with some points only: index -> (x, y) or (x, y, score)."""
    table = keypoint_schema(schema)
    points = np.zeros((table.point_count, 3))
    for index, place in places.items():
        points[index] = (*place, 1.0)[:3]
    return label(table.category, schema, points)


def _draw(*labels, width: int = 768, height: int = 512, **kwargs) -> np.ndarray:
    """Labels in the picture's own pixels."""
    return draw_skeletons(labels, width=width, height=height, label_width=width, label_height=height, **kwargs)


@pytest.mark.parametrize("schema", ["car66", "car24"])
def test_edge_hues_run_from_blue_around_the_circle_in_floating_point(schema):
    count = len(keypoint_schema(schema).edges)
    assert count == {"car66": 108, "car24": 49}[schema]
    hues = ((240 - 360 * np.arange(count) / count) % 360) / 360
    expected = hsv_to_rgb(np.column_stack([hues, np.ones(count), np.ones(count)])) * 255
    assert np.abs(edge_colours(schema) - expected).max() <= 0.5 + 1e-9
    assert len(np.unique(edge_colours(schema), axis=0)) == count


@pytest.mark.parametrize("schema", ["car66", "car24"])
def test_a_car_holds_no_colour_but_its_edges(schema):
    picture = _draw(car(schema=schema), width=1056, height=704)
    colours = {tuple(colour) for colour in picture[picture.any(axis=2)].tolist()}
    assert colours <= {tuple(colour) for colour in edge_colours(schema).tolist()}
    assert len(colours) > len(edge_colours(schema)) / 2


@pytest.mark.parametrize("edge", [0, 17, 48])
def test_a_line_has_the_colour_of_its_edge_and_a_dot_at_each_end(edge):
    a, b = keypoint_schema("car24").edges[edge]
    picture = _draw(_few_points("car24", {a: (100, 200), b: (300, 200)}))
    assert picture[200, 200].tolist() == edge_colours("car24")[edge].tolist()
    for point, x in ((a, 100), (b, 300)):
        assert picture[200, x].tolist() == edge_colours("car24")[dot_edges("car24")[point]].tolist()
    assert 1 <= picture[:, 200].any(axis=1).sum() <= 2, "a line is one to two pixels wide at 768x512"
    assert picture[:, 100].any(axis=1).sum() == 3, "a dot is a little wider than a line"


@pytest.mark.parametrize("schema", ["car66", "car24"])
def test_each_point_has_an_edge_of_its_own_for_its_dot(schema):
    chosen, edges = dot_edges(schema), keypoint_schema(schema).edges
    assert len(set(chosen.tolist())) == keypoint_schema(schema).point_count
    assert all(point in edges[edge] for point, edge in enumerate(chosen))


def test_colour_names_the_part_and_never_the_instance():
    one, other = car(right_m=-4, track_id=1), car(right_m=4, track_id=77)
    swapped = replace(one, track_id=77), replace(other, track_id=1)
    assert np.array_equal(_draw(one, other), _draw(*swapped))


def test_labels_scale_about_pixel_centres():
    here = busy_street(cars=4, people=2)
    moved = []
    for one in here:
        points = one.points.astype(np.float64)
        points[:, 0], points[:, 1] = (points[:, 0] + 0.5) * 768 / 1056 - 0.5, (points[:, 1] + 0.5) * 512 / 704 - 0.5
        moved.append(replace(one, points=points.astype(np.float32)))
    scaled, direct = draw_skeletons(here, width=768, height=512), _draw(*moved)
    assert (scaled != direct).any(axis=2).mean() < 1e-4, "only float32 rounding may differ"


def test_widths_scale_with_the_picture():
    thick = {}
    for size in (1, 2, 4):
        picture = _draw(
            _few_points("lane24", {0: (50, 100), 23: (700 * size, 100)}), width=768 * size, height=512 * size
        )
        thick[size] = int(picture[:, 50 + (700 * size - 50) // 46].any(axis=1).sum())
    assert all(abs(rows - 2 * size) <= 1 for size, rows in thick.items()), "a lane's line is 2 pixels at 768x512"


@pytest.mark.parametrize("width,height", [(24, 16), (96, 64), (264, 176)])
def test_no_line_and_no_dot_is_lost_in_a_small_picture(width, height):
    for offset in np.linspace(0, 1, 7):
        one = _few_points("car24", {0: (3 + offset, 3 + offset / 2), 16: (width - 4 + offset, height / 2 + offset)})
        picture = _draw(one, width=width, height=height)
        assert picture[:, 4 : width - 4].any(axis=(0, 2)).all()
        assert _draw(_few_points("car24", {5: (5 + offset, 5 + offset)}), width=width, height=height).any()


def test_the_order_of_labels_makes_no_difference_and_near_covers_far():
    labels = busy_street(cars=8, people=3)
    assert np.array_equal(_draw(*labels), _draw(*labels[::-1]))
    far = _few_points("car24", {0: (100, 100), 16: (300, 100)})
    near = replace(_few_points("car24", {1: (200, 50), 6: (200, 150)}), track_id=5)
    assert _draw(near, far)[100, 200].tolist() == edge_colours("car24")[4].tolist()


def test_a_busy_street_lights_a_small_share_of_the_picture():
    labels = [lane(right_m=-1.8), lane(right_m=1.8), car(ahead_m=15), car(right_m=4, ahead_m=20, track_id=1)]
    share = draw_skeletons(labels, width=768, height=512).any(axis=2).mean()
    assert 0.006 < share < 0.03


# Lanes


def test_lane_points_are_spaced_evenly_by_arc_length():
    bend = np.array([[0.0, 0.0], [10.0, 0.0], [11.0, 0.0], [11.0, 30.0]])
    line = complete_lane(bend)
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    assert len(line) == 24 and np.allclose(line[[0, -1]], bend[[0, -1]])
    assert np.allclose(np.delete(np.diff(along), 5), 41 / 23, atol=0.3), "but for chords over the corner"


def test_a_lane_of_some_points_is_a_white_line_with_24_dots():
    picture = _draw(_few_points("lane24", {2: (40, 400), 9: (300, 300), 20: (700, 100)}))
    assert set(np.unique(picture)) == {0, 255} and (picture == picture[..., :1]).all()
    dots = cv2.erode(picture[..., 0], np.ones((3, 3), np.uint8))
    assert cv2.connectedComponents(dots)[0] - 1 == 24


@pytest.mark.parametrize("places", [{}, {3: (10, 10)}, {3: (10, 10), 4: (10, 10)}, {0: (9, 9, 0.2), 5: (90, 90, 0.2)}])
def test_a_lane_of_fewer_than_two_places_is_not_drawn(places):
    assert not _draw(_few_points("lane24", places)).any()


# People


def test_limbs_have_openpose_colours_dimmed_by_confidence():
    table = facts()["openpose18"]
    for limb, (a, b) in enumerate(table["limbs_zero_based"]):
        for score in (1.0, 0.5):
            picture = _draw(_few_points("openpose18", {a: (100, 100, score), b: (300, 100, score)}))
            expected = np.array(table["colours_rgb"][limb]) * score
            assert np.abs(picture[100, 200] - expected).max() <= 1
            assert np.abs(picture[100, 100] - np.array(table["colours_rgb"][a]) * score).max() <= 1


@pytest.mark.parametrize("score,seen", [(0.31, True), (0.3, False), (0.1, False)])
def test_the_neck_needs_both_shoulders(score, seen):
    points = np.zeros((1, 17, 3))
    points[0, 5], points[0, 6] = (100, 50, 0.9), (140, 70, score)
    neck = openpose_body(points, "coco17")[0, 1]
    assert (neck[2] > 0) == seen
    assert np.allclose(neck[:2], (120, 60))


def test_17_joints_are_drawn_as_the_body_of_133():
    whole = person(schema="wholebody133")
    body_only = whole.points.copy()
    body_only[17:] = 0
    coco = label("person", "coco17", whole.points[:17])
    as_whole = replace(whole, points=body_only, box_xyxy=coco.box_xyxy)
    assert np.array_equal(_draw(coco), _draw(as_whole))
    assert _draw(whole).any(axis=2).sum() > _draw(coco).any(axis=2).sum(), "hands and face come on top"


def test_left_and_right_are_openposes():
    left_wrist, right_wrist = 9, 10
    body = openpose_body(np.arange(51.0).reshape(1, 17, 3), "coco17")[0]
    assert body[7, 0] == 3 * left_wrist and body[4, 0] == 3 * right_wrist


def test_unsure_points_are_not_drawn():
    assert not _draw(person(score=0.29)).any()
    assert _draw(person(score=0.29), style=SkeletonStyle(min_score=0.2)).any()


def test_face_dots_are_white_times_confidence():
    picture = _draw(_few_points("wholebody133", {40: (50, 50, 0.6)}))
    assert picture[50, 50].tolist() == [153, 153, 153]


# The rasteriser and the mask of lit cells


def test_capsules_are_the_pixels_within_their_radius():
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))
    for ends in rng.uniform(-10, 45, (200, 4)):
        radius = rng.uniform(0.5, 6)
        picture = np.zeros((30, 40, 3), np.uint8)
        fill_capsules(
            picture, Capsules(ends=ends[None], radii=np.array([radius]), colours=np.full((1, 3), 200, np.uint8))
        )
        way = ends[2:] - ends[:2]
        share = np.clip(((x - ends[0]) * way[0] + (y - ends[1]) * way[1]) / (way @ way), 0, 1)
        distance = np.hypot(x - ends[0] - share * way[0], y - ends[1] - share * way[1])
        sure = np.abs(distance - radius) > 1e-9
        assert np.array_equal((picture[..., 0] > 0)[sure], (distance <= radius)[sure])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    schema=st.sampled_from(["car66", "car24", "lane24", "wholebody133", "coco17", "openpose18"]),
    size=st.sampled_from([(768, 512, 32), (96, 64, 32), (64, 64, 8), (1056, 704, 32)]),
    spread=st.sampled_from([20.0, 400.0, 5000.0, 1e9]),
)
def test_a_cell_is_lit_exactly_where_the_drawing_has_a_lit_pixel(seed, schema, size, spread):
    width, height, cell = size
    rng = np.random.default_rng(seed)
    table = keypoint_schema(schema)
    frames = []
    for _ in range(2):
        points = [
            np.column_stack([rng.normal(500, spread, table.point_count), rng.normal(350, spread, table.point_count),
                             rng.uniform(0, 1, table.point_count)]) for _ in range(2)
        ]  # fmt: skip
        frames.append([label(table.category, schema, one, track_id=i) for i, one in enumerate(points)])
    lit = lit_cells(frames, width=width, height=height, cell=cell)
    drawn = np.stack([draw_skeletons(labels, width=width, height=height).any(axis=2) for labels in frames])
    blocks = drawn.reshape(2, height // cell, cell, width // cell, cell).any(axis=(2, 4))
    assert np.array_equal(lit, blocks)


def test_nothing_labelled_is_black_and_unlit():
    assert not draw_skeletons([], width=64, height=64).any()
    assert lit_cells([[], []], width=64, height=96).shape == (2, 3, 2)
    assert not lit_cells([[]], width=64, height=64).any()
    assert len(skeleton_capsules([], width=64, height=64).radii) == 0


def test_sizes_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="sizes are positive"):
        draw_skeletons([], width=0, height=64)
    with pytest.raises(ConfigError, match="whole number of 32-pixel cells"):
        lit_cells([[]], width=100, height=64)


def test_drawings_match_the_golden_pictures():
    spec = importlib.util.spec_from_file_location("make_skeleton_goldens", GOLDEN / "make_skeleton_goldens.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name, labels in module.scenes().items():
        golden = cv2.imread(str(GOLDEN / f"skeleton_{name}.png"))
        assert golden is not None
        # A centre that lies on a shape's rim may fall either way on another processor.
        assert (module.draw(labels) != golden[..., ::-1]).any(axis=2).mean() < 1e-4, name


# Reading back


def _errors(found, truth) -> tuple[np.ndarray, float]:
    """Distances of the points in common with ``truth``, and the share of those in the picture that were read."""
    inside = (truth.points[:, :2] >= 0).all(axis=1) & (truth.points[:, :2] < [1056, 704]).all(axis=1)
    seen = (truth.points[:, 2] > 0) & inside
    both = (found.points[:, 2] > 0) & (truth.points[:, 2] > 0)
    return np.hypot(*(found.points - truth.points)[both, :2].T), float((found.points[seen, 2] > 0).mean())


@pytest.mark.parametrize("schema", ["car66", "car24"])
@pytest.mark.parametrize("heading_deg", [0, 35, 90, 160, 250])
@pytest.mark.parametrize("hide", [False, True], ids=["glass", "far side hidden"])
def test_a_car_is_read_back_within_two_pixels(schema, heading_deg, hide):
    truth = car(schema=schema, heading_deg=heading_deg, ahead_m=11, right_m=1, hide_far_side=hide)
    picture = draw_skeletons([truth, lane(right_m=-6)], width=768, height=512)
    (found,) = skeletons_from_frame(picture, schema=schema, frame=4)
    errors, share = _errors(found, truth)
    assert errors.max() <= 2.0 and np.median(errors) < 0.7
    assert share >= 0.95
    assert found.frame == 4 and not found.points[truth.points[:, 2] == 0].any(), "nothing is made up"


def test_cars_apart_are_read_back_apart():
    truth = [
        car(right_m=-4.2, ahead_m=13, heading_deg=30, track_id=0),
        car(right_m=0.5, ahead_m=25, heading_deg=5, track_id=1),
        car(right_m=5, ahead_m=16, heading_deg=160, track_id=2),
    ]
    found = skeletons_from_frame(draw_skeletons(truth, width=1056, height=704))
    assert len(found) == 3
    for one in truth:
        nearest = min(found, key=lambda other: np.abs(other.box_xyxy - one.box_xyxy).max())
        errors, share = _errors(nearest, one)
        assert (errors <= 2.0).all() and share >= 0.85, "of a far car dots cover dots"


def test_a_drawing_without_cars_gives_no_cars():
    picture = draw_skeletons([lane(right_m=-1), person(), person(right_m=2, track_id=1)], width=768, height=512)
    assert skeletons_from_frame(picture) == []
    assert skeletons_from_frame(np.zeros((64, 64, 3), np.uint8)) == []


def test_noise_and_blank_pictures_do_not_break_the_reading():
    noise = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    skeletons_from_frame(noise, schema="car24")
    assert skeletons_from_frame(np.full((64, 96, 3), 255, np.uint8)) == []


def test_only_pictures_of_cars_can_be_read():
    with pytest.raises(DataError, match="uint8 RGB"):
        skeletons_from_frame(np.zeros((4, 4, 3), np.float32))
    with pytest.raises(DataError, match="only cars"):
        skeletons_from_frame(np.zeros((4, 4, 3), np.uint8), schema="lane24")

"""Top-down keypoints: a planted response comes back to its pixel, through crop and inverse; absent stays absent."""

from pathlib import Path

import cv2
import numpy as np
import onnx_fixtures
import pytest
from onnx import helper

from labeling.errors import ModelError
from labeling.keypoints import KeypointHead, PersonHead, decode_simcc, plan_crop
from labeling.model_cards import SimccCard
from labeling.schemas import keypoint_schema

WIDTH, HEIGHT = 64, 96


def head_card(schema: str = "coco17", **changes: object) -> SimccCard:
    values = {
        "name": schema, "file": "head.onnx", "schema": schema, "input_width": WIDTH, "input_height": HEIGHT,
        "licence": "none", "source": "-", **changes,
    }  # fmt: skip
    return SimccCard.model_validate(values)


def make_head(folder: Path, schema: str = "coco17", *, seed: int = 0, max_batch: int = 8) -> KeypointHead:
    count = keypoint_schema(schema).point_count
    path = onnx_fixtures.random_simcc(folder / f"{schema}.onnx", points=count, width=WIDTH, height=HEIGHT, seed=seed)
    return KeypointHead(head_card(schema), path, max_batch=max_batch)


BOXES = [(100, 50, 180, 300), (10, 10, 400, 60), (0, 0, 5, 5), (-40, -30, 60, 80), (630.5, 470.25, 700, 600)]


@pytest.mark.parametrize("box", BOXES, ids=str)
def test_the_crop_holds_the_box_at_the_networks_aspect(box: tuple[float, ...]) -> None:
    crop = plan_crop(np.array(box), head_card())
    assert crop is not None
    width, height = crop.size_xy
    assert width / height == pytest.approx(WIDTH / HEIGHT)
    assert width >= 1.25 * (box[2] - box[0]) - 1e-9 and height >= 1.25 * (box[3] - box[1]) - 1e-9
    assert min(width / (box[2] - box[0]), height / (box[3] - box[1])) == pytest.approx(1.25)


@pytest.mark.parametrize("box", BOXES, ids=str)
def test_to_frame_inverts_the_crop(box: tuple[float, ...]) -> None:
    crop = plan_crop(np.array(box), head_card())
    assert crop is not None
    points = np.random.default_rng(0).uniform(-50, 700, (30, 2))
    there = points @ crop.frame_to_input[:, :2].T + crop.frame_to_input[:, 2]
    np.testing.assert_allclose(crop.to_frame(there), points, atol=1e-3)
    np.testing.assert_allclose(crop.frame_to_input @ [*crop.centre_xy, 1], [WIDTH / 2, HEIGHT / 2], atol=1e-3)


@pytest.mark.parametrize(
    "box", [(5, 5, 5, 50), (5, 5, 50, 5), (50, 50, 5, 5), (np.nan, 0, 1, 1), (0, 0, np.inf, 1)], ids=str
)
def test_boxes_without_area_have_no_crop(box: tuple[float, ...]) -> None:
    assert plan_crop(np.array(box), head_card()) is None


def test_a_planted_response_is_read_at_half_a_pixel_and_scored_by_the_lesser() -> None:
    simcc_x, simcc_y = np.full((3, 128), -1, np.float32), np.full((3, 192), -1, np.float32)
    simcc_x[0, 41], simcc_y[0, 100] = 0.9, 0.6
    simcc_x[1, 7], simcc_y[1, 3] = 0.8, -0.1
    simcc_x[2, 0], simcc_y[2, 0] = 0.0, 0.5
    points = decode_simcc(simcc_x, simcc_y, split=2)
    np.testing.assert_allclose(points, [[20.5, 50, 0.6], [0, 0, 0], [0, 0, 0]], rtol=1e-6)


def test_a_bright_spot_is_found_in_the_frame_where_it_is(tmp_path: Path) -> None:
    """A network whose responses are the picture's own column and row sums must find a spot anywhere in the frame."""
    nodes = [
        helper.make_node("ReduceMean", ["input"], ["grey"], axes=[1], keepdims=0),
        helper.make_node("ReduceSum", ["grey", "down"], ["x"], keepdims=1),
        helper.make_node("ReduceSum", ["grey", "across"], ["y"], keepdims=1),
        helper.make_node("Reshape", ["y", "row"], ["y_row"]),
        helper.make_node("Tile", ["x", "points"], ["simcc_x"]),
        helper.make_node("Tile", ["y_row", "points"], ["simcc_y"]),
    ]
    weights = {
        "down": np.array([1]), "across": np.array([2]), "row": np.array([0, 1, HEIGHT]),
        "points": np.array([1, 17, 1]),
    }  # fmt: skip
    path = onnx_fixtures.save_graph(
        tmp_path / "head.onnx", nodes, weights=weights, inputs={"input": ["n", 3, HEIGHT, WIDTH]},
        outputs={"simcc_x": ["n", 17, WIDTH], "simcc_y": ["n", 17, HEIGHT]},
    )  # fmt: skip
    head = KeypointHead(head_card(simcc_split=1.0, mean=(0, 0, 0), std=(255, 255, 255)), path)
    for spot in [(120, 200), (95, 60), (133, 281)]:
        frame = np.zeros((480, 640, 3), np.uint8)
        cv2.circle(frame, spot, 4, (255, 255, 255), -1)
        (points,) = head.estimate([frame], [np.array([[80, 40, 160, 300]])])
        np.testing.assert_allclose(points[0, 0, :2], spot, atol=1.25 * 260 / HEIGHT)


def test_crops_of_many_frames_share_batches_and_keep_their_places(tmp_path: Path) -> None:
    head = make_head(tmp_path, max_batch=3)
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (300 + 20 * i, 400, 3), dtype=np.uint8) for i in range(3)]
    boxes = [
        np.array([[10, 10, 60, 100], [50, 20, 200, 250]], np.float32), np.zeros((0, 4), np.float32),
        np.array([[0, 0, 399, 339], [5, 5, 5, 90], [900, 900, 950, 990], [30, 40, 90, 95]], np.float32),
    ]  # fmt: skip
    found = head.estimate(frames, boxes)
    assert [points.shape for points in found] == [(2, 17, 3), (0, 17, 3), (4, 17, 3)]
    assert not found[2][1].any() and not found[2][2].any(), "a box without area or outside has no points"
    for frame, given, points in zip(frames, boxes, found, strict=True):
        for box, one in zip(given, points, strict=True):
            np.testing.assert_allclose(head.estimate([frame], [box[None]])[0][0], one, atol=1e-4)
    assert head.estimate([], []) == []
    assert all(((points[..., 2] >= 0) & (points[..., 2] <= 1)).all() for points in found)


def test_points_stay_within_their_crop(tmp_path: Path) -> None:
    frame = np.random.default_rng(1).integers(0, 256, (400, 500, 3), dtype=np.uint8)
    box = np.array([100, 100, 150, 220], np.float32)
    (points,) = make_head(tmp_path).estimate([frame], [box[None]])
    present = points[0, points[0, :, 2] > 0, :2]
    crop = plan_crop(box, head_card())
    assert crop is not None and len(present)
    low = np.subtract(crop.centre_xy, np.multiply(crop.size_xy, 0.5))
    assert (present >= low - 1e-3).all() and (present <= low + crop.size_xy).all()


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="uint8 RGB"):
        make_head(tmp_path).estimate([np.zeros((90, 90, 3))], [np.array([[10, 10, 50, 50]])])


class TestPeople:
    BOXES = np.array([[50, 50, 120, 300], [200, 100, 230, 180], [300, 20, 380, 121]], np.float32)
    FRAME = np.random.default_rng(2).integers(0, 256, (400, 500, 3), dtype=np.uint8)

    def test_small_people_get_seventeen_joints_of_the_full_network(self, tmp_path: Path) -> None:
        full = make_head(tmp_path, "wholebody133")
        (points,) = PersonHead(full).estimate([self.FRAME], [self.BOXES])
        (everyone,) = full.estimate([self.FRAME], [self.BOXES])
        assert not points[1, 17:].any() and points[1, :17].any()
        np.testing.assert_array_equal(points[[0, 2]], everyone[[0, 2]])
        np.testing.assert_array_equal(points[1, :17], everyone[1, :17])

    def test_small_people_go_to_the_small_network(self, tmp_path: Path) -> None:
        full, small = make_head(tmp_path, "wholebody133"), make_head(tmp_path, "coco17", seed=5)
        (points,) = PersonHead(full, small=small).estimate([self.FRAME], [self.BOXES])
        np.testing.assert_allclose(points[1, :17], small.estimate([self.FRAME], [self.BOXES[1:2]])[0][0], atol=1e-4)
        assert not points[1, 17:].any()
        np.testing.assert_allclose(points[[0, 2]], full.estimate([self.FRAME], [self.BOXES[[0, 2]]])[0], atol=1e-4)

    def test_the_height_is_a_setting(self, tmp_path: Path) -> None:
        full = make_head(tmp_path, "wholebody133")
        (everyone,) = full.estimate([self.FRAME], [self.BOXES])
        (points,) = PersonHead(full, small_below_px=0).estimate([self.FRAME], [self.BOXES])
        np.testing.assert_array_equal(points, everyone)
        (points,) = PersonHead(full, small_below_px=1000).estimate([self.FRAME], [self.BOXES])
        assert not points[:, 17:].any()

    def test_no_person_is_no_person(self, tmp_path: Path) -> None:
        none = np.zeros((0, 4), np.float32)
        (points,) = PersonHead(make_head(tmp_path, "wholebody133")).estimate([self.FRAME], [none])
        assert points.shape == (0, 133, 3)

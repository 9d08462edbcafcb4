"""YOLOX decoding and suppression: planted boxes come back; hostile frames end well; the real network sees real cars."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx_fixtures
import pytest
from pydantic import ValidationError

from labeling.detection import Detections, Detector, decode_yolox, letterbox, soften_overlaps, suppress_overlaps
from labeling.errors import ModelError
from labeling.model_cards import SoftSuppression, YoloxCard, load_cards

WIDTH, HEIGHT = 160, 96


def toy_card(**changes: object) -> YoloxCard:
    values = {
        "name": "toy", "file": "toy.onnx", "input_width": WIDTH, "input_height": HEIGHT, "licence": "none",
        "source": "-", "classes": ("car", "truck", "person", "dog"),
        "categories": {"car": "car", "truck": "car", "person": "person"},
        **changes,
    }  # fmt: skip
    return YoloxCard.model_validate(values)


def raw_output(boxes: Sequence[tuple[float, float, float, float, int, float]], *, stride: int = 8) -> np.ndarray:
    """The grid output that decodes to boxes (left, top, right, bottom, class, score) in network pixels.

    Each is in the cell of its centre, or the next free one.
    """
    output = np.zeros((sum((WIDTH // s) * (HEIGHT // s) for s in (8, 16, 32)), 9), np.float32)
    first = {8: 0, 16: 240, 32: 300}[stride]
    across = WIDTH // stride
    for left, top, right, bottom, label, score in boxes:
        x, y = (left + right) / 2 / stride, (top + bottom) / 2 / stride
        column, row = int(np.clip(x, 0, across - 1)), int(np.clip(y, 0, HEIGHT // stride - 1))
        cell = first + row * across + column
        while output[cell, 4]:
            cell += 1
            column, row = (cell - first) % across, (cell - first) // across
        output[cell, :4] = x - column, y - row, np.log((right - left) / stride), np.log((bottom - top) / stride)
        output[cell, 4], output[cell, 5 + label] = 1, score
    return output


def detect(
    boxes: list, *, ratio: float = 1.0, width: int = WIDTH, height: int = HEIGHT, **changes: object
) -> Detections:
    return decode_yolox(raw_output(boxes), toy_card(**changes), ratio=ratio, width=width, height=height)


@pytest.mark.parametrize("stride", [8, 16, 32])
def test_planted_boxes_come_back_on_every_stride(stride: int) -> None:
    boxes = [(10, 20, 50, 60, 0, 0.9), (90, 30, 110, 90, 2, 0.7)]
    found = decode_yolox(raw_output(boxes, stride=stride), toy_card(), ratio=0.5, width=320, height=192)
    np.testing.assert_allclose(found.boxes_xyxy, np.array([box[:4] for box in boxes]) * 2, atol=1e-3)
    assert found.classes.tolist() == ["car", "person"] and found.categories.tolist() == ["car", "person"]
    np.testing.assert_allclose(found.scores, [0.9, 0.7])


def test_doubles_go_within_a_class_only() -> None:
    found = detect(
        [(10, 10, 50, 50, 0, 0.6), (12, 11, 52, 51, 0, 0.9), (11, 10, 51, 50, 1, 0.8), (11, 9, 51, 49, 2, 0.5)]
    )
    assert found.classes.tolist() == ["car", "truck", "person"]
    assert found.scores[0] == pytest.approx(0.9)
    assert found.distinct().classes.tolist() == ["car", "person"]
    assert len(found.of_category("car")) == 1 and len(found.of_category("person")) == 1


def test_classes_without_a_category_are_kept_and_told_apart() -> None:
    found = detect([(10, 10, 50, 50, 3, 0.6), (11, 11, 50, 50, 0, 0.9)])
    assert found.classes.tolist() == ["car", "dog"] and found.categories.tolist() == ["car", ""]
    assert len(found.distinct()) == 2


def test_boxes_are_cut_at_the_borders_and_those_outside_left_out() -> None:
    found = detect([(-30, -20, 40, 50, 0, 0.9), (140, 70, 190, 120, 0, 0.8), (170, 10, 220, 40, 0, 0.7)])
    np.testing.assert_allclose(found.boxes_xyxy, [[0, 0, 40, 50], [140, 70, 160, 96]], atol=1e-3)


def test_two_objects_cut_to_one_stripe_stay_two() -> None:
    found = detect([(-60, 10, 4, 60, 0, 0.9), (-2, 10, 4, 60, 0, 0.8)])
    assert len(found) == 2


@pytest.mark.parametrize("score", [0.29, 0.31])
def test_the_threshold_is_the_cards(score: float) -> None:
    assert len(detect([(10, 10, 50, 50, 0, score)])) == (score > 0.3)
    assert len(detect([(10, 10, 50, 50, 0, score)], score_threshold=0.1)) == 1


def test_a_class_may_have_a_threshold_of_its_own() -> None:
    boxes = [(10, 10, 50, 50, 0, 0.35), (70, 10, 90, 60, 2, 0.2), (100, 10, 130, 60, 3, 0.35)]
    found = detect(boxes, score_thresholds={"car": 0.4, "person": 0.15})
    assert found.classes.tolist() == ["dog", "person"]
    with pytest.raises(ValueError, match="decided_classes name classes"):
        toy_card(score_thresholds={"horse": 0.4})


@pytest.mark.parametrize(
    ("told", "car", "person"),
    [({}, 0.5, 0.5), ({"car": 0.7}, 0.5, 0.5), ({"car": 0.7, "truck": 0.6}, 0.6, 0.5), ({"person": 0.8}, 0.5, 0.8),
     ({"truck": 0.4}, 0.4, 0.5)],
    ids=str,
)  # fmt: skip
def test_a_category_is_as_sure_as_its_most_trusted_class(told: dict[str, float], car: float, person: float) -> None:
    assert toy_card(sure_scores=told).category_sure_scores == {"car": car, "person": person}


def test_a_category_is_decided_where_all_its_classes_are() -> None:
    assert toy_card().decided_categories == frozenset()
    assert toy_card(decided_classes=["car"]).decided_categories == frozenset()
    assert toy_card(decided_classes=["car", "truck"]).decided_categories == {"car"}
    with pytest.raises(ValueError, match="decided_classes name classes"):
        toy_card(decided_classes=["horse"])


def test_an_empty_frame_has_no_detections() -> None:
    found = detect([])
    assert len(found) == 0 and found.boxes_xyxy.shape == (0, 4)
    assert len(found.distinct()) == len(found.of_category("car")) == 0


def test_widths_beyond_all_measure_stay_finite() -> None:
    output = raw_output([(10, 10, 50, 50, 0, 0.9)])
    output[output[:, 4] > 0, 2:4] = 500
    found = decode_yolox(output, toy_card(), ratio=1, width=WIDTH, height=HEIGHT)
    assert found.boxes_xyxy.tolist() == [[0, 0, WIDTH, HEIGHT]]


def test_five_hundred_detections_are_cut_to_the_best_and_said() -> None:
    rng = np.random.default_rng(0)
    output = np.zeros((8400, 85), np.float32)
    output[:500, :2] = rng.uniform(0, 1, (500, 2))
    output[:500, 2:4] = -2
    output[:500, 4] = 1
    output[np.arange(500), 5 + rng.integers(0, 80, 500)] = rng.uniform(0.4, 1, 500)
    found = decode_yolox(output, load_cards()["yolox_l"], ratio=1, width=640, height=640)  # type: ignore[arg-type]
    assert len(found) == 200 and len(found) + found.left_out == 500
    assert (np.diff(found.scores) <= 0).all()
    assert found.scores.min() >= np.sort(output[:500, 5:].max(axis=1))[-200] - 1e-6


def test_a_frame_where_every_cell_sees_everything_ends() -> None:
    output = np.full((8400, 85), 0.9, np.float32)
    found = decode_yolox(output, load_cards()["yolox_l"], ratio=1, width=640, height=640)  # type: ignore[arg-type]
    assert len(found) <= 200


def test_suppression_equals_the_plain_double_loop() -> None:
    rng = np.random.default_rng(1)
    corners = rng.uniform(0, 60, (80, 2))
    boxes = np.concatenate([corners, corners + rng.uniform(5, 40, (80, 2))], axis=1)
    labels = rng.integers(0, 3, 80)

    def overlap(a: np.ndarray, b: np.ndarray) -> float:
        sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
        shared = float(np.prod(np.maximum(sides, 0)))
        return shared / (float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])) - shared)

    plain: list[int] = []
    for i in range(80):
        if not any(labels[i] == labels[k] and overlap(boxes[i], boxes[k]) > 0.3 for k in plain):
            plain.append(i)
    assert suppress_overlaps(boxes, labels, 0.3).tolist() == plain


def test_soft_suppression_keeps_a_confident_neighbour_and_drops_a_double() -> None:
    boxes = np.array([[0, 0, 60, 60], [20, 0, 80, 60], [2, 1, 62, 61], [300, 0, 360, 60], [20, 0, 80, 60]], np.float32)
    scores, labels = np.array([0.9, 0.8, 0.7, 0.6, 0.5], np.float32), np.array([0, 0, 0, 0, 1])
    soft, least = SoftSuppression(sigma=0.4), np.full(5, 0.25)
    keep, left = soften_overlaps(boxes, scores, labels, soft, least)
    assert keep.tolist() == [0, 3, 4, 1]
    # A half is shared with the first: 40 of 60 px, so 40 / 80.
    np.testing.assert_allclose(left[keep], [0.9, 0.6, 0.5, 0.8 * np.exp(-0.25 / 0.4)], rtol=1e-6)
    assert suppress_overlaps(boxes, labels, 0.45).tolist() == [0, 3, 4]


def test_a_part_of_a_better_box_costs_what_lies_inside() -> None:
    boxes = np.array([[0, 0, 100, 100], [60, 50, 90, 100], [90, 50, 120, 100]], np.float32)
    scores, labels, least = np.array([0.9, 0.6, 0.6], np.float32), np.zeros(3, int), np.full(3, 0.1)
    soft = SoftSuppression(sigma=0.4, part_cost=0.4)
    np.testing.assert_allclose(
        soften_overlaps(boxes, scores, labels, soft, least)[1], [0.9, 0.6 * 0.6, 0.6 * (1 - 0.4 / 3)], rtol=1e-6
    )
    plain = SoftSuppression(sigma=0.4)
    assert soften_overlaps(boxes, scores, labels, plain, least)[1].min() > 0.55


@pytest.mark.parametrize("seed", range(5))
def test_soft_suppression_equals_the_plain_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 60, (60, 2))
    boxes = np.concatenate([corners, corners + rng.uniform(5, 60, (60, 2))], axis=1)
    scores, labels = np.sort(rng.uniform(0.2, 1, 60))[::-1].copy(), rng.integers(0, 2, 60)
    plain: list[tuple[int, float]] = []
    left, rest = scores.tolist(), list(range(60))
    while rest:
        best = max(rest, key=lambda i: left[i])
        rest.remove(best)
        plain.append((best, left[best]))
        for other in rest:
            if labels[other] == labels[best]:
                corner, end = (
                    np.maximum(boxes[best, :2], boxes[other, :2]),
                    np.minimum(boxes[best, 2:], boxes[other, 2:]),
                )
                shared = float(np.prod(np.maximum(end - corner, 0)))
                areas = [float(np.prod(boxes[k, 2:] - boxes[k, :2])) for k in (best, other)]
                overlap = shared / (sum(areas) - shared)
                left[other] *= min(np.exp(-(overlap**2) / 0.3), 1 - 0.5 * shared / areas[1])
    wanted = [(index, score) for index, score in plain if score > 0.2]
    soft = SoftSuppression(sigma=0.3, part_cost=0.5)
    keep, values = soften_overlaps(boxes, scores, labels, soft, np.full(60, 0.2))
    assert 3 < len(keep) < 60 and keep.tolist() == [index for index, _ in wanted]
    np.testing.assert_allclose(values[keep], [score for _, score in wanted])


def test_a_card_may_ask_for_soft_suppression() -> None:
    output = raw_output([(0, 0, 60, 60, 0, 0.9), (20, 0, 80, 60, 0, 0.8), (2, 1, 62, 61, 0, 0.7)])
    card = toy_card(soft_nms={"sigma": 0.4}, score_threshold=0.25)
    found = decode_yolox(output, card, ratio=1, width=WIDTH, height=HEIGHT)
    np.testing.assert_allclose(found.scores, [0.9, 0.8 * np.exp(-0.25 / 0.4)], rtol=1e-5)
    assert len(found.of_category("car")) == 2
    with pytest.raises(ValidationError, match="sigma"):
        toy_card(soft_nms={"sigma": 0.0})


@pytest.mark.parametrize("size", [(96, 160), (540, 960), (960, 540), (1, 1), (3, 4000)], ids=str)
def test_the_letterbox_keeps_the_aspect_and_pads_with_grey(size: tuple[int, int]) -> None:
    picture, ratio = letterbox(np.full((*size, 3), 200, np.uint8), toy_card())
    height, width = max(1, int(size[0] * ratio)), max(1, int(size[1] * ratio))
    assert picture.shape == (3, HEIGHT, WIDTH)
    assert (picture[:, :height, :width] == 200).all()
    assert (picture[:, height:] == 114).all() and (picture[:, :, width:] == 114).all()


@pytest.mark.parametrize(
    "frame",
    [np.zeros((10, 10), np.uint8), np.zeros((10, 10, 3), np.float32), np.zeros((0, 10, 3), np.uint8)],
    ids=["grey", "float", "empty"],
)
def test_what_is_no_picture_is_refused(frame: np.ndarray) -> None:
    with pytest.raises(ModelError, match="uint8 RGB"):
        letterbox(frame, toy_card())


def test_frames_of_many_sizes_go_through_one_batch_as_they_go_alone(tmp_path: Path) -> None:
    card = toy_card(score_threshold=0.25)
    path = onnx_fixtures.random_yolox(tmp_path / "toy.onnx", classes=4, width=WIDTH, height=HEIGHT)
    detector = Detector(card, path, max_batch=2)
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in ((96, 160), (200, 100), (50, 300))]
    for found, frame in zip(detector.detect(frames), frames, strict=True):
        (alone,) = detector.detect([frame])
        assert len(found) and len(found) == len(alone)
        np.testing.assert_allclose(found.boxes_xyxy, alone.boxes_xyxy, atol=1e-2)
        assert found.boxes_xyxy.max() <= max(frame.shape)
    assert detector.detect([]) == []


def read_every(path: Path, step: int) -> list[np.ndarray]:
    """Every ``step``-th frame of a video, RGB."""
    capture = cv2.VideoCapture(str(path))
    frames = []
    while capture.grab():
        frames.append(capture.retrieve()[1][:, :, ::-1].copy() if len(frames) % step == 0 else np.zeros(0))
    return frames[::step]


def test_the_real_detector_finds_several_cars_in_most_frames(real_data: Path) -> None:
    detector = Detector(load_cards()["yolox_nano"], real_data / "yolox_nano.onnx")  # type: ignore[arg-type]
    frames = read_every(real_data / "solidWhiteRight.mp4", 20)
    counts = [len(found.of_category("car")) for found in detector.detect(frames)]
    assert np.mean(np.array(counts) >= 2) > 0.8 and np.median(counts) >= 3
    (sixtieth,) = detector.detect([frames[3]])
    assert len(sixtieth.of_category("car")) == 5


@pytest.mark.parametrize("size", [(96, 160), (30, 200), (200, 30)], ids=str)
def test_the_letterbox_leaves_nothing_of_what_was_there(size: tuple[int, int]) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    card = toy_card(channel_order="rgb", mean=(10, 20, 30), std=(2, 3, 4))
    batch = np.full((2, 3, HEIGHT, WIDTH), np.nan, np.float32)
    letterbox(frame, card, out=batch[1])
    np.testing.assert_array_equal(batch[1], letterbox(frame, card)[0])
    assert np.isnan(batch[0]).all()

"""Boxes and keypoints beside ``rtmlib`` (Apache-2.0), with the same ONNX files, on real frames.

Where it departs from us, on purpose of ours, and what is compared therefore:

- it leaves the channel order to its caller: it is given BGR for YOLOX and RGB for the head, as the cards say;
- its thresholds default to 0.7; it is given the card's;
- it measures overlap on boxes one pixel larger (``x2 - x1 + 1``): two boxes at the very threshold may be judged
  otherwise, which on these frames never happens;
- it neither cuts boxes at the borders nor drops those outside: its boxes are cut before they are compared;
- it returns no box scores; ours are checked against the raw network output elsewhere;
- it scores a point by the mean of both maxima (we by the lesser) and places it at -1/2 px where that is not positive
  (we call it absent): raw responses are compared by our formula and by its own;
- without a person it takes the whole picture for one; we give none.

``python tests/benchmarks/bench_batches.py`` repeats the comparison on every frame.
"""

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import onnx_fixtures
import pytest

from labeling.detection import Detector
from labeling.keypoints import KeypointHead, plan_crop
from labeling.model_cards import SimccCard, YoloxCard, load_cards
from pipelines.keypoint_clips import HELD_OUT_SEED, street_extractors, street_frames
from pipelines.peers import rtmlib_detector

HEAD_SIZE = (192, 256)

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("rtmlib") is None, reason="rtmlib is not installed: pip install --no-deps rtmlib==0.0.16"
)


def some_frames(path: Path, *, step: int = 20) -> Iterator[np.ndarray]:
    """Every ``step``-th frame, RGB."""
    capture, number = cv2.VideoCapture(str(path)), 0
    while capture.grab():
        if number % step == 0:
            yield np.ascontiguousarray(capture.retrieve()[1][:, :, ::-1])
        number += 1


def yolox_card() -> YoloxCard:
    card = load_cards()["yolox_nano"]
    assert isinstance(card, YoloxCard)
    return card


def head_card() -> SimccCard:
    values = {"name": "random", "file": "random.onnx", "schema": "wholebody133", "licence": "none", "source": "a test"}
    return SimccCard.model_validate({**values, "input_width": HEAD_SIZE[0], "input_height": HEAD_SIZE[1]})


@pytest.fixture(scope="module")
def random_head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("head") / "random.onnx"
    return onnx_fixtures.random_simcc(path, points=133, width=HEAD_SIZE[0], height=HEAD_SIZE[1])


def peer_boxes(peer: object, frame: np.ndarray, card: YoloxCard) -> list[tuple[str, np.ndarray]]:
    """rtmlib's boxes of a frame, cut at its borders, with the class names."""
    boxes, labels = peer(np.ascontiguousarray(frame[:, :, ::-1]))  # type: ignore[operator]
    boxes = np.clip(boxes.reshape(-1, 4), 0, [frame.shape[1], frame.shape[0]] * 2)
    return [(card.class_names[label], box) for label, box in zip(labels, boxes, strict=True)]


def test_yolox_gives_rtmlibs_boxes_within_half_a_pixel(real_data: Path) -> None:
    from rtmlib import YOLOX

    card, path = yolox_card(), real_data / "yolox_nano.onnx"
    peer = YOLOX(
        str(path), model_input_size=(card.input_height, card.input_width), det_mode="multiclass",
        nms_thr=card.nms_threshold, score_thr=card.score_threshold, backend="onnxruntime",
    )  # fmt: skip
    detector, total = Detector(card, path), 0
    for frame in some_frames(real_data / "solidWhiteRight.mp4"):
        (found,) = detector.detect([frame])
        theirs = peer_boxes(peer, frame, card)
        assert sorted(found.classes) == sorted(name for name, _ in theirs)
        for name, box in theirs:
            mine = found.boxes_xyxy[found.classes == name]
            assert np.abs(mine - box).max(axis=1).min() < 0.5
        total += len(theirs)
    assert total > 30


def test_levels_are_centred_for_rtmlib_as_a_card_says() -> None:
    """The shipped detector takes them so, and rtmlib knows of nothing of the kind."""
    clip = street_frames("traffic", HELD_OUT_SEED, 1)
    ours = street_extractors().detector
    assert ours is not None and ours.card.mean != (0, 0, 0)
    (found,) = ours.detect(clip.frames)
    boxes, _ = rtmlib_detector(ours.card)(np.ascontiguousarray(clip.frames[0][:, :, ::-1]))
    height, width = clip.frames[0].shape[:2]
    boxes = np.clip(boxes, 0, [width, height, width, height])
    assert len(found) > 5 and len(boxes) == len(found)
    np.testing.assert_allclose(boxes[np.lexsort(boxes.T)], found.boxes_xyxy[np.lexsort(found.boxes_xyxy.T)], atol=0.5)


def test_simcc_gives_rtmlibs_keypoints_within_a_hundredth_of_a_pixel(real_data: Path, random_head: Path) -> None:
    from rtmlib import RTMPose

    head = KeypointHead(head_card(), random_head)
    peer = RTMPose(str(random_head), model_input_size=HEAD_SIZE, backend="onnxruntime")
    rng, compared = np.random.default_rng(0), 0
    for frame in some_frames(real_data / "solidWhiteRight.mp4", step=60):
        corners = rng.uniform(-20, 500, (6, 2))
        boxes = np.concatenate([corners, corners + rng.uniform(15, 300, (6, 2))], axis=1)
        boxes = boxes[boxes[:, 1] < 500]
        (points,) = head.estimate([frame], [boxes])
        theirs, their_scores = peer(frame, list(boxes))
        present = points[..., 2] > 0
        assert np.abs(points[..., :2] - theirs)[present].max() < 1e-2
        # Ours is the lesser of two maxima, theirs the mean: never more, and absent wherever theirs is.
        assert (points[..., 2] <= np.maximum(their_scores, 0) + 1e-5).all()
        compared += int(present.sum())
    assert compared > 500


def test_raw_responses_agree_and_the_two_scores_follow_from_them(real_data: Path, random_head: Path) -> None:
    from rtmlib import RTMPose

    from labeling.keypoints import crop_input

    head = KeypointHead(head_card(), random_head)
    peer = RTMPose(str(random_head), model_input_size=HEAD_SIZE, backend="onnxruntime")
    frame = next(some_frames(real_data / "solidWhiteRight.mp4"))
    box = np.array([300.0, 280.0, 420.0, 400.0])
    crop = plan_crop(box, head.card)
    assert crop is not None
    mine = head.model.run(crop_input(frame, crop, head.card)[None])
    picture, centre, scale = peer.preprocess(frame, list(box))
    np.testing.assert_array_equal(crop_input(frame, crop, head.card).transpose(1, 2, 0), picture.astype(np.float32))
    np.testing.assert_allclose(scale, crop.size_xy, rtol=1e-6)
    np.testing.assert_allclose(centre, crop.centre_xy, rtol=1e-6)
    theirs = peer.inference(picture)
    for ours, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(ours, np.asarray(other), atol=1e-5)
    (points,), (_, scores) = head.estimate([frame], [box[None]]), peer(frame, [box])
    maxima = np.stack([response.max(axis=-1) for response in mine])
    np.testing.assert_allclose(points[..., 2], np.clip(maxima.min(axis=0), 0, 1), atol=1e-5)
    positive = scores > 0
    np.testing.assert_allclose(scores[positive], maxima.mean(axis=0)[positive], atol=2e-3)


def test_without_a_person_rtmlib_takes_the_picture_and_we_take_none(real_data: Path, random_head: Path) -> None:
    from rtmlib import RTMPose

    frame = next(some_frames(real_data / "solidWhiteRight.mp4"))
    theirs, _ = RTMPose(str(random_head), model_input_size=HEAD_SIZE, backend="onnxruntime")(frame, [])
    (points,) = KeypointHead(head_card(), random_head).estimate([frame], [np.zeros((0, 4))])
    assert len(theirs) == 1 and len(points) == 0

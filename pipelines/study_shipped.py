"""What the project's own extractors make of the study's pictures, upscaled: reported beside the study's own judge."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from labeling.boxes import best_pairs
from labeling.camera import Intrinsics
from labeling.detection import Detector
from labeling.ego_motion import estimate_ego_motion
from labeling.labels import Keypoints
from labeling.model_cards import YoloxCard, find_weights, load_cards
from labeling.skeleton_reading import skeletons_from_frame
from labeling.skeleton_video import draw_skeletons
from pipelines.study_data import StudyClip
from training.criteria import MATCH_IOU
from training.metrics import ade_m
from training.study_judge import is_counted

_UPSCALED = 4
_MOST_CLIPS = 6
_SURE = 0.5


def shipped_figures(clips: Sequence[StudyClip], *, small: Callable[[StudyClip], np.ndarray]) -> dict[str, float]:
    """Recall of the shipped street detector and of the skeletons read back, error and coverage of ego-motion.

    Args:
        clips: the first few are looked at, as drawn, not through the VAE.
        small: a clip's video at the study's size.
    """
    chosen = clips[: min(_MOST_CLIPS, len(clips) // 2)]
    videos = [small(clip) for clip in chosen]
    ways = [_ego(clip, video) for clip, video in zip(chosen, videos, strict=True)]
    found = [hit for clip, video in zip(chosen, videos, strict=True) for hit in _detected(clip, video)]
    read = [hit for clip, video in zip(chosen, videos, strict=True) for hit in _read_back(clip, video)]
    figures = {
        "clips": float(len(chosen)), "detector_recall": _mean(found), "skeletons_read_back_recall": _mean(read),
        "ego_motion_ade_m": _mean([error for error, _ in ways]),
        "ego_motion_sure_share": _mean([sure for _, sure in ways]),
        "path_m": _mean([float(np.linalg.norm(clip.cam_to_world[-1, :3, 3])) for clip in chosen]),
    }  # fmt: skip
    return {name: round(value, 4) for name, value in figures.items()}


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else 0.0


def _large(video: np.ndarray) -> list[np.ndarray]:
    size = (_UPSCALED * video.shape[2], _UPSCALED * video.shape[1])
    return [cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC) for frame in video]


def _ego(clip: StudyClip, video: np.ndarray) -> tuple[float, float]:
    """ADE in metres, unaligned, and the share of frames that the estimate is sure of."""
    frames, camera = _large(video), clip.street.intrinsics
    height, width = frames[0].shape[:2]
    scale = width / camera.width
    own = Intrinsics(
        width=width, height=height, fx=camera.fx * scale, fy=camera.fy * scale, cx=(width - 1) / 2,
        cy=(height - 1) / 2, source="given",
    )  # fmt: skip
    times = np.arange(len(frames)) / clip.scale.clip_fps
    motion = estimate_ego_motion(frames, times, intrinsics=own)
    error = ade_m(motion.trajectory.cam_to_world, clip.cam_to_world, alignment="none")
    return error, float((motion.confidence >= _SURE).mean())


def _detected(clip: StudyClip, video: np.ndarray) -> list[float]:
    """For each car that is asked for in the first and the last frame, 1 where the shipped detector finds it."""
    card = load_cards()["street_detector"]
    path = find_weights(card, None)
    assert isinstance(card, YoloxCard)
    assert path is not None
    detector, hits = Detector(card, path), []
    for index in (0, len(video) - 1):
        frame = _large(video[index : index + 1])[0]
        found = detector.detect([frame])[0]
        boxes = found.boxes_xyxy[found.categories == "car"] * (clip.scale.label_width / frame.shape[1])
        hits += _hits(clip, index, boxes)
    return hits


def _read_back(clip: StudyClip, video: np.ndarray) -> list[float]:
    """The same for cars read back from the true skeletons, drawn at the study's size."""
    hits = []
    wide, high = clip.scale.label_width, clip.scale.label_height
    for index in (0, len(video) - 1):
        labels: list[Keypoints] = clip.street.keypoints(clip.rendered[index])
        drawn = draw_skeletons(
            labels, width=clip.scale.width, height=clip.scale.height, label_width=wide, label_height=high
        )
        cars = skeletons_from_frame(drawn, schema="car24", label_width=wide, label_height=high)
        hits += _hits(clip, index, np.array([car.box_xyxy for car in cars]))
    return hits


def _hits(clip: StudyClip, index: int, boxes: np.ndarray) -> list[float]:
    """For each car that is asked for, 1 where a box is its own: none stands for two of them."""
    asked = [car.box_xyxy for car in clip.cars()[index] if is_counted(car.box_xyxy, car.visible_share)]
    true, found = (np.array(some, np.float64).reshape(-1, 4) for some in (asked, boxes))
    own = {row for row, _, _ in best_pairs(true, found, least_iou=MATCH_IOU)}
    return [float(row in own) for row in range(len(asked))]

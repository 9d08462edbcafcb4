"""What the figures of generated clips stand beside: answers that need no model, as records of the same kind."""

from dataclasses import replace

import numpy as np

from labeling.camera import rigid
from labeling.labels import Keypoints
from training.evaluation import ClipTruth, SampleEstimate

_VELOCITY_SECONDS = 0.25


def constant_velocity(truth: ClipTruth) -> SampleEstimate:
    """The baseline that goes on as the clip's first quarter of a second went: the camera, and each object's box."""
    past = int(np.searchsorted(truth.times_s, _VELOCITY_SECONDS - 1e-6))
    past = min(max(1, past), len(truth.times_s) - 1)
    elapsed = float(truth.times_s[past]) if past else 1.0
    velocity = truth.cam_to_world[past, :3, 3] / elapsed
    poses = rigid(np.tile(np.eye(3), (len(truth.times_s), 1, 1)), truth.times_s[:, None] * velocity)
    return SampleEstimate(
        name="constant velocity", times_s=truth.times_s, width=truth.width, height=truth.height, cam_to_world=poses,
        labels=tuple(_moved_on(truth, past)),
    )  # fmt: skip


def held_first_frame(floor: SampleEstimate) -> SampleEstimate:
    """The baseline that shows the first frame all the time: no motion, and the labels found in that frame, held."""
    count = len(floor.times_s)
    first = [] if floor.labels is None else [label for label in floor.labels if label.frame == 0]
    labels = tuple(replace(label, frame=frame) for frame in range(count) for label in first)
    return SampleEstimate(
        name="first frame", times_s=floor.times_s, width=floor.width, height=floor.height,
        cam_to_world=np.tile(np.eye(4), (count, 1, 1)), labels=None if floor.labels is None else labels,
        faults={part: reason for part, reason in floor.faults.items() if part in ("video", "labels")},
    )  # fmt: skip


def _moved_on(truth: ClipTruth, past: int) -> list[Keypoints]:
    """Labels of frame 0 that move on as they moved until frame ``past``; what left before is held."""
    later = {label.track_id: label for label in truth.labels if label.frame == past}
    labels = []
    for label in truth.labels:
        if label.frame != 0:
            continue
        goal = later.get(label.track_id, label)
        box_step, point_step = goal.box_xyxy - label.box_xyxy, goal.points[:, :2] - label.points[:, :2]
        # A point seen in one of the two frames only has no velocity of its own.
        both = (label.present & goal.present)[:, None]
        middle = (box_step[:2] + box_step[2:]) / 2
        for frame in range(len(truth.times_s)):
            points = label.points.copy()
            points[:, :2] += np.where(both, point_step, middle) * (frame / max(past, 1))
            box = label.box_xyxy + box_step * np.float32(frame / max(past, 1))
            labels.append(replace(label, frame=frame, box_xyxy=box.astype(np.float32), points=points))
    return labels

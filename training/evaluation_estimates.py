"""Generated videos to records: what the project's own estimators find in them, at their own frame rate and size.

The same code looks at samples and at the truth's video (the noise floor), so that what the estimators get wrong is seen
beside what the samples get wrong. Whatever fails is a fault with its reason.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dataset.loader import Sample
from labeling.camera import Intrinsics, cover_map
from labeling.ego_import import MISSING, motion_at, read_drive
from labeling.ego_motion import EgoMotion, EgoSettings, RoadView, solve_run
from labeling.ego_tracks import track_run
from labeling.encoding import VideoWriter
from labeling.errors import AnimaticError, DataError, TrajectoryError, VideoError
from labeling.extraction import Effort, label_frames
from labeling.extractors import Extractors
from labeling.labels import Keypoints
from labeling.object_video import chosen_tracks
from labeling.skeleton_reading import skeletons_from_frame
from labeling.skeleton_video import draw_skeletons
from labeling.video import frame_count, read_frames
from training.evaluation import ClipTruth, SampleEstimate, nearest_frames, with_fault
from training.evaluation_files import SampleFiles, SampleVideo, read_sample
from training.label_agreement import mapped_labels
from training.metrics import picture_similarity
from training.sampling_inputs import covered

LEAST_CONFIDENCE = 0.3
"""Median over the frames below which a camera trajectory is no answer: noise has 0, a clean street 0.9 and more."""
MOST_LOST = 0.25
"""Share of frames without any motion of their own (held, or after a cut) above which it is none."""
MOST_SCALE_SIGMA = 0.4
"""Relative sigma of the metric scale above which metres are unknown; a scene without a road has 0.8."""
_READABLE_SCHEMAS = ("car66", "car24")
_SURE_PITCH_RAD = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimateSettings:
    """How generated videos are looked at."""

    every: int = 8
    """Pictures are compared, and skeleton videos read, every so many frames."""
    effort: Effort = "balanced"
    """How often the extractors look; as for the job's own labels."""
    ego: EgoSettings = field(default_factory=EgoSettings)


def clip_truth(
    sample: Sample, *, object_variant: int = 0, ego_condition: np.ndarray | None = None, shown: int | None = None
) -> ClipTruth:
    """A packed clip as the truth of its samples.

    Args:
        sample: the clip.
        object_variant: which of the object videos the samples were conditioned on.
        ego_condition: (T, 4, 4) trajectory that was asked for instead of the clip's own.
        shown: frames from the clip's first that the object videos were made of: only tracks in them were drawn from.
            None means the whole clip.

    Raises:
        DataError: a member that is missing or broken, or an ``ego_condition`` of another length.
    """
    meta, poses = sample.meta, sample.cam_to_world
    if ego_condition is not None and len(ego_condition) != len(poses):
        raise DataError(f"{sample.key}: was conditioned on {len(ego_condition)} poses, the clip has {len(poses)}")
    labels = tuple(label for label in sample.keypoints() if label.category != "lane")
    inside = [label for label in labels if shown is None or label.frame < shown]
    return ClipTruth(
        key=sample.key, video_id=meta["video_id"], split=meta.get("split", "train"),
        times_s=np.arange(len(poses)) / float(meta["fps"]), cam_to_world=poses, ego_condition=ego_condition,
        labels=labels, box_tracks=frozenset(chosen_tracks(inside, key=sample.key, variant=object_variant)),
        width=meta["picture"]["width"], height=meta["picture"]["height"],
    )  # fmt: skip


class ClipEstimator:
    """Looks at all samples of one clip.

    Args:
        sample: the packed clip; its pictures are held in memory.
        truth: of ``clip_truth``.
        extractors: those that labelled the job, or None to judge neither boxes nor keypoints.
        settings: how to look.
    """

    def __init__(
        self, sample: Sample, truth: ClipTruth, *, extractors: Extractors | None,
        settings: EstimateSettings | None = None,
    ) -> None:  # fmt: skip
        self.truth, self.extractors, self.settings = truth, extractors, settings or EstimateSettings()
        self.pictures = list(sample.iterate_frames("rgb.mp4"))
        meta = sample.meta
        self._intrinsics = Intrinsics(**meta["intrinsics"])
        self._road: Mapping[str, Any] = meta["ego"]["road"]
        schemas = {label.schema for label in truth.labels}
        self._car_schema = next((schema for schema in _READABLE_SCHEMAS if schema in schemas), None)

    def estimate(self, files: SampleFiles) -> SampleEstimate:
        """What one sample shows; faults instead of what cannot be told."""
        name = files.rgb.stem
        try:
            video = read_sample(files.rgb)
        except AnimaticError as error:
            nothing = SampleEstimate(name=name, times_s=np.zeros(0), width=0, height=0)
            return with_fault(nothing, "video", _reason(error, files.rgb))
        found = self._labelled(name, video)
        found = self._with_trajectory(found, video, files)
        found = self._with_pictures(found, video)
        return self._with_skeletons(found, files.skeleton) if files.skeleton else found

    def floor(self, like: SampleEstimate, *, skeleton_size: tuple[int, int] | None = None) -> SampleEstimate:
        """The truth's own video at a sample's frame rate and size, and the truth's skeletons drawn and read back.

        It is encoded again, as a sample is: the very frames that were labelled would give the very labels back.
        """
        times = like.times_s[like.times_s <= self.truth.times_s[-1] + 1e-6]
        indices = nearest_frames(self.truth.times_s, times)
        frames = [covered(self.pictures[index], width=like.width, height=like.height) for index in indices]
        video = SampleVideo(frames=encoded_again(frames), times_s=times)
        found = self._with_ego(self._labelled("truth video", video), video)
        found = self._with_pictures(found, video)
        if skeleton_size is None or self._car_schema is None:
            return found
        width, height = skeleton_size
        drawn = {
            frame: draw_skeletons(
                [one for one in self.truth.labels if one.frame == indices[frame]], width=width, height=height,
                label_width=self.truth.width, label_height=self.truth.height,
            )
            for frame in self._looks(len(times))
        }  # fmt: skip
        return self._read_back(found, drawn)

    def held(self, baseline: SampleEstimate) -> SampleEstimate:
        """The baseline that holds the first frame, with its pictures compared."""
        if not baseline.readable:
            return baseline
        first = covered(self.pictures[0], width=baseline.width, height=baseline.height)
        return self._with_pictures(
            baseline, SampleVideo(frames=[first] * len(baseline.times_s), times_s=baseline.times_s)
        )

    def _labelled(self, name: str, video: SampleVideo) -> SampleEstimate:
        width, height = video.size
        estimate = SampleEstimate(name=name, times_s=video.times_s, width=width, height=height)
        if self.extractors is None:
            return estimate
        try:
            found = label_frames(video.frames, first_frame=0, extractors=self.extractors, effort=self.settings.effort)
        except AnimaticError as error:
            return with_fault(estimate, "labels", _reason(error))
        return replace(estimate, labels=tuple(label for label in found if label.category != "lane"))

    def _with_trajectory(self, found: SampleEstimate, video: SampleVideo, files: SampleFiles) -> SampleEstimate:
        if not files.wants_trajectory:
            return self._with_ego(found, video)
        if files.trajectory is None:
            return with_fault(found, "ego", "no trajectory file")
        try:
            poses = imported_poses(files.trajectory, video.times_s, intrinsics=self._intrinsics)
        except AnimaticError as error:
            return with_fault(found, "ego", _reason(error, files.trajectory))
        return replace(found, cam_to_world=poses)

    def _with_ego(self, found: SampleEstimate, video: SampleVideo) -> SampleEstimate:
        picture = cover_map(self.truth.width, self.truth.height, width=found.width, height=found.height)
        boxes = None
        if found.labels is not None:
            by_frame: list[list[np.ndarray]] = [[] for _ in video.frames]
            for label in found.labels:
                by_frame[label.frame].append(label.box_xyxy)
            boxes = [np.array(these, np.float32).reshape(-1, 4) for these in by_frame]
        try:
            tracks = track_run(video.frames, video.times_s, boxes=boxes, settings=self.settings.ego.tracks)
            # The camera is the clip's, so what the job knows of its pitch holds for every sample.
            sigma, pitch = self._road.get("pitch_sigma_rad"), self._road.get("pitch_rad")
            motion = solve_run(
                tracks, intrinsics=self._intrinsics.mapped(picture), camera_height_m=float(self._road["height_m"]),
                pitch_rad=pitch if sigma is not None and sigma < _SURE_PITCH_RAD else None,
                settings=self.settings.ego,
            )  # fmt: skip
        except AnimaticError as error:
            return with_fault(found, "ego", _reason(error))
        fault = ego_fault(motion)
        if fault is not None:
            return with_fault(found, "ego", fault)
        return replace(found, cam_to_world=motion.trajectory.cam_to_world)

    def _with_pictures(self, found: SampleEstimate, video: SampleVideo) -> SampleEstimate:
        psnr, ssim = np.full(len(video.frames), np.nan), np.full(len(video.frames), np.nan)
        nearest = nearest_frames(self.truth.times_s, video.times_s)
        # The first frame is given to every generator; the last one stands for clips shorter than a step.
        for frame in self._looks(len(video.frames))[1:] or [len(video.frames) - 1]:
            if video.times_s[frame] <= self.truth.times_s[-1] + 1e-6:
                true = covered(self.pictures[nearest[frame]], width=found.width, height=found.height)
                try:
                    psnr[frame], ssim[frame] = picture_similarity(video.frames[frame][None], true[None])
                except AnimaticError as error:
                    return with_fault(found, "picture", _reason(error))
        return replace(found, psnr_db=psnr, ssim=ssim)

    def _with_skeletons(self, found: SampleEstimate, path: Path) -> SampleEstimate:
        if self._car_schema is None:
            return found
        try:
            count = frame_count(path)
            if count != len(found.times_s):
                raise VideoError(f"skeleton video has {count} frames, the RGB video {len(found.times_s)}")
            looks = set(self._looks(count))
            drawn = {frame: picture for frame, picture in enumerate(read_frames(path)) if frame in looks}
        except AnimaticError as error:
            return with_fault(found, "skeleton", _reason(error, path))
        return self._read_back(found, drawn)

    def _read_back(self, found: SampleEstimate, drawn: Mapping[int, np.ndarray]) -> SampleEstimate:
        """Cars of skeleton pictures by frame; a control picture is the truth's whole picture, whatever its shape."""
        cars: list[Keypoints] = []
        for frame, picture in drawn.items():
            cars += skeletons_from_frame(
                picture, schema=self._car_schema or "car24", frame=frame, label_width=self.truth.width,
                label_height=self.truth.height,
            )  # fmt: skip
        plan = cover_map(self.truth.width, self.truth.height, width=found.width, height=found.height)
        return replace(found, skeletons=tuple(mapped_labels(cars, plan)), skeleton_frames=tuple(drawn))

    def _looks(self, count: int) -> range:
        return range(0, count, self.settings.every)


def ego_fault(motion: EgoMotion) -> str | None:
    """Why a camera trajectory is no answer, or None.

    A wrong trajectory given confidently would be worse than none; standing still is an answer.
    """
    confidence = float(np.median(motion.confidence))
    if confidence < LEAST_CONFIDENCE:
        return f"confidence {confidence:.2f} < {LEAST_CONFIDENCE}"
    lost = float(np.isin(motion.mode, ["held", "cut"]).mean())
    if lost > MOST_LOST:
        return f"no motion of their own in {lost:.0%} of the frames"
    moving = motion.mode == "moving"
    sigma = float(np.median(motion.scale_sigma[moving])) if moving.mean() > 0.5 else 0.0
    if sigma > MOST_SCALE_SIGMA:
        return f"metric scale unknown (sigma {sigma:.0%}): no road seen"
    return None


def encoded_again(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Frames (H, W, 3) as they come back from an MP4 that ``animatic generate`` would write; of odd sizes, as they are.

    4:2:0 pictures have even sides.
    """
    height, width = frames[0].shape[:2]
    if height % 2 or width % 2:
        return list(frames)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "truth.mp4"
        with VideoWriter(path, width=width, height=height, fps=24) as writer:
            for frame in frames:
                writer.write(np.ascontiguousarray(frame))
        return list(read_frames(path))


def imported_poses(path: Path, times_s: np.ndarray, *, intrinsics: Intrinsics) -> np.ndarray:
    """(n, 4, 4) of a trajectory file at a video's times, which count from 0 s in both.

    Raises:
        TrajectoryError: it cannot be read, or says nothing about some of the frames.
    """
    drive = read_drive(path, video_times_s=times_s)
    road = RoadView(height_m=1.0, pitch_rad=0.0, pitch_sigma_rad=float("inf"))
    motion = motion_at(drive, times_s, intrinsics=intrinsics, road=road)
    missing = motion.mode == MISSING
    if missing.any():
        raise TrajectoryError(
            f"{path.name}: says nothing about {int(missing.sum())} of {len(times_s)} frames, the first at "
            f"{times_s[int(missing.argmax())]:.2f} s; give rows for the whole video, 0.25 s apart at most"
        )
    return motion.trajectory.cam_to_world


def _reason(error: AnimaticError, path: Path | None = None) -> str:
    """The error's words on one line, files by their names: figures do not depend on where folders lie."""
    text = " ".join(str(error).split())
    return text.replace(f"{path.parent}/", "") if path is not None else text

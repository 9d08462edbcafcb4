"""Folders of generated videos: which file is a sample of which clip, and its frames at their own times and size."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labeling.errors import AnimaticError, DataError, VideoError
from labeling.packet_times import HOLE_S, read_packet_times
from labeling.video import decode_frames, probe

SKELETONS = "skeleton"
"""Folder of the skeleton videos beside a folder of samples, as ``animatic generate`` writes them."""
CONDITIONS = "conditions"
"""Folder of what samples were conditioned on: ``<key>.tum``, where it is not the clip's own trajectory."""
_NUMBERED = re.compile(r"(?P<key>.+)_(?P<number>\d+)")


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleFiles:
    """Where one sample lies."""

    rgb: Path
    number: int = 0
    """Its number among the clip's samples."""
    skeleton: Path | None = None
    """Its skeleton video, where there is one."""
    trajectory: Path | None = None
    """TUM or KITTI file, to be taken in place of the project's own estimate; times count from 0 s."""
    wants_trajectory: bool = False
    """Trajectories are imported: a sample without one has failed, and is not estimated by another ruler."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleFolder:
    """A folder of samples, by clip."""

    folder: Path
    by_key: Mapping[str, tuple[SampleFiles, ...]]
    """In the order of keys, then of numbers."""
    strangers: tuple[str, ...]
    """Files that are named after no clip of the job."""
    beyond: int
    """Samples left out because each clip is judged by the same number of them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleVideo:
    """A generated video as it was decoded."""

    frames: list[np.ndarray]
    """n pictures (H, W, 3) uint8 RGB."""
    times_s: np.ndarray
    """(n,) float64 from 0."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.frames[0].shape[1], self.frames[0].shape[0]


def find_samples(
    folder: Path, keys: Collection[str], *, most: int = 6, trajectories: Path | None = None,
    skeletons: Path | None = None,
) -> SampleFolder:  # fmt: skip
    """The samples of a job's clips in a folder of MP4 files named ``<key>[_n]``, whoever made them.

    Args:
        folder: where they lie; folders in it are not looked into.
        keys: of the job's clips.
        most: samples of a clip that count, those with the least numbers.
        trajectories: folder of ``<key>[_n].tum``; the project's own estimates where None.
        skeletons: folder of skeleton videos of the same names; ``<folder>/skeleton`` where None.

    Raises:
        DataError: no such folder, no sample of any clip in it, or a name that two clips could have.
    """
    for given in (folder, trajectories, skeletons):
        if given is not None and not given.is_dir():
            raise DataError(f"{given}: is no folder; name one of videos called <key>_<n>.mp4")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".mp4" and path.is_file())
    names = {path: sample_name(path.stem, keys) for path in paths}
    strangers = tuple(path.name for path, name in names.items() if name is None)
    if len(strangers) == len(paths):
        near, have = ", ".join(sorted(keys)[:3]) or "none", ", ".join(strangers[:3]) or "no MP4 file"
        raise DataError(
            f"{folder}: holds {have}; samples are named <key>[_n].mp4 after the job's clips, such as {near}"
        )
    by_key: dict[str, list[SampleFiles]] = {}
    for path, name in names.items():
        if name is not None:
            files = _files(path, name[1], skeletons or folder / SKELETONS, trajectories)
            by_key.setdefault(name[0], []).append(files)
    kept = {
        key: tuple(sorted(these, key=lambda one: (one.number, one.rgb.name))[:most]) for key, these in by_key.items()
    }
    beyond = sum(len(these) for these in by_key.values()) - sum(len(these) for these in kept.values())
    return SampleFolder(folder=folder, by_key=dict(sorted(kept.items())), strangers=strangers, beyond=beyond)


def sample_name(stem: str, keys: Collection[str]) -> tuple[str, int] | None:
    """The clip and the number that a file's stem names, or None.

    Raises:
        DataError: it names two clips: keys end in a number themselves.
    """
    numbered = _NUMBERED.fullmatch(stem)
    whole, split = stem in keys, numbered is not None and numbered["key"] in keys
    if whole and split and numbered is not None:
        raise DataError(
            f"{stem}.mp4 can be the clip {stem} or sample {numbered['number']} of {numbered['key']}; number every "
            f"sample: {stem}_0.mp4"
        )
    if whole:
        return stem, 0
    return (numbered["key"], int(numbered["number"])) if split and numbered is not None else None


def shown_frames(record: Path) -> int | None:
    """How many frames of its clip, from the first, a generator's conditions were made of; None where nothing tells.

    Args:
        record: ``<key>.json`` beside the samples, as ``animatic generate`` writes it.
    """
    try:
        tree = json.loads(record.read_text(encoding="utf-8"))
        step = tree["frame_step"] if "frame_step" in tree else tree["backbone"]["picture"]["frame_step"]
        return (int(tree["frames"]) - 1) * int(step) + 1
    except (OSError, ValueError, KeyError, TypeError):
        # Samples of others have no record, or one of their own.
        return None


def read_sample(path: Path) -> SampleVideo:
    """All frames of a generated video, at its own size and times.

    Raises:
        VideoError: it cannot be opened, is cut off, holds frames that do not decode, or a single frame.
    """
    packets = read_packet_times(path)
    # Below 4 fps every step is as long as a hole in a recording; one that lacks a frame is longer than the others.
    steps_s = np.diff(packets.times_s)
    hole_s = max(HOLE_S, 1.5 * float(np.median(steps_s))) if len(steps_s) else HOLE_S
    decoded = [(frame.time_s, frame.rgb) for frame in decode_frames(path, hole_s=hole_s) if frame.is_clean]
    count = len(packets.times_s) + packets.broken_packets
    if len(decoded) < count:
        raise VideoError(f"{path.name}: {len(decoded)} of {count} frames decode; write it again")
    if len(decoded) < 2:
        raise VideoError(f"{path.name}: holds a single frame; a clip needs two")
    return SampleVideo(
        frames=[rgb for _, rgb in decoded], times_s=np.array([time for time, _ in decoded]) - decoded[0][0]
    )


def video_size(path: Path | None) -> tuple[int, int] | None:
    """Width and height of a video; None where there is none that can be read."""
    if path is None:
        return None
    try:
        info = probe(path)
    except AnimaticError:
        return None
    return info.width, info.height


def video_rate(times_s: Sequence[float] | np.ndarray) -> float:
    """Frames per second; 0 for fewer than two frames."""
    times = np.asarray(times_s)
    return float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else 0.0


def _files(path: Path, number: int, skeletons: Path, trajectories: Path | None) -> SampleFiles:
    skeleton = skeletons / f"{path.stem}.mp4"
    trajectory = trajectories / f"{path.stem}.tum" if trajectories else None
    return SampleFiles(
        rgb=path, number=number, skeleton=skeleton if skeleton.is_file() else None,
        trajectory=trajectory if trajectory and trajectory.is_file() else None,
        wants_trajectory=trajectories is not None,
    )  # fmt: skip

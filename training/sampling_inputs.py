"""What a person gives to the generator, as frames of the right size: image, first skeleton, ego and object video."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from dataset.tables import read_keypoints
from labeling.camera import Intrinsics, Trajectory, cover_map, read_kitti, read_tum, rebased_trajectory, resample
from labeling.ego_import import trajectory_format
from labeling.ego_video import ego_frames
from labeling.errors import ConfigError, DataError
from labeling.labels import Keypoints
from labeling.object_video import object_frames
from labeling.skeleton_video import LABEL_WIDTH, draw_skeletons
from labeling.timeline import Span
from labeling.video import read_frames
from training.config import PictureConfig
from training.ego_recipes import recipe_trajectory

if TYPE_CHECKING:
    from labeling.extractors import ExtractorChoice

_MOST_STRETCH = 0.01
"""Of one side against the other: half a pixel in a hundred at the picture's edge."""


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB.

    Raises:
        DataError: no picture there.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise DataError(f"{path} is not a picture that can be read; give a PNG or JPEG")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def covered(picture: np.ndarray, *, width: int, height: int) -> np.ndarray:
    """A picture scaled to cover the size and centre-cropped, as source videos are."""
    plan = cover_map(picture.shape[1], picture.shape[0], width=width, height=height)
    shrinks = plan.scaled_width < picture.shape[1]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    scaled = cv2.resize(picture, (plan.scaled_width, plan.scaled_height), interpolation=method)
    return scaled[plan.crop_y : plan.crop_y + height, plan.crop_x : plan.crop_x + width]


def check_aspect(picture: PictureConfig, *, width: int, height: int) -> None:
    """Refuse sizes of another shape than a clip's.

    Training scales each side of a clip by itself, sampling crops the first frame: that is the same for one shape alone.

    Args:
        picture: the backbone's sizes.
        width: of the clip's picture, pixels.
        height: of the clip's picture, pixels.

    Raises:
        ConfigError: a size whose aspect is more than 1 % off.
    """
    sizes = ((picture.control_width, picture.control_height), (picture.rgb_width, picture.rgb_height))
    for wide, high in sizes:
        stretch = wide * height / (high * width)
        if max(stretch, 1 / stretch) > 1 + _MOST_STRETCH:
            raise ConfigError(
                f"the clips' pictures are {width}x{height} (aspect {width / height:.3f}), the backbone's {wide}x{high} "
                f"({wide / high:.3f}): they would be squeezed in training and cropped in sampling; set picture's sizes "
                "to the clips' aspect, or cut the job's pictures to the backbone's"
            )


def fitted(frames: np.ndarray, *, width: int, height: int) -> np.ndarray:
    """Control frames (T, H, W, 3) at another size, without mixing their colours."""
    if frames.shape[1:3] == (height, width):
        return frames
    return np.stack([cv2.resize(one, (width, height), interpolation=cv2.INTER_NEAREST) for one in frames])


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledFrame:
    """The keypoints of the first frame, to be drawn at whatever size the backbone takes."""

    labels: Sequence[Keypoints]
    width: int
    """Of the picture that the labels are in, pixels."""
    height: int

    def drawn(self, picture: PictureConfig) -> np.ndarray:
        """(H, W, 3) at the controls' size.

        Raises:
            ConfigError: the backbone's pictures have another aspect.
        """
        check_aspect(picture, width=self.width, height=self.height)
        return draw_skeletons(
            self.labels, width=picture.control_width, height=picture.control_height, label_width=self.width,
            label_height=self.height,
        )  # fmt: skip


def first_skeleton(
    image: np.ndarray,
    *,
    picture: PictureConfig,
    extractors: Sequence[str] | None = None,
    models_dir: Path | None = None,
) -> np.ndarray:
    """(H, W, 3): the skeletons that the extractors see in the image, drawn at the controls' size.

    Args:
        image: (H, W, 3) uint8 RGB, any size.
        picture: the backbone's sizes.
        extractors: model cards by name, ``street`` for the shipped ones; None for all whose weights are there.
        models_dir: where weights lie.

    Raises:
        ConfigError: no extractor that gives keypoints.
    """
    from labeling.extractors import Extractors
    from labeling.observation import looks_of

    choice = skeleton_extractors(extractors, models_dir=models_dir)
    # Extractors look at pictures of their own width, whatever the backbone's size.
    height = 2 * round(LABEL_WIDTH * picture.rgb_height / picture.rgb_width / 2)
    seen = covered(image, width=LABEL_WIDTH, height=height)
    looks = looks_of(Extractors(choice, models_dir=models_dir))
    labels: list[Keypoints] = [label for look in looks for label in look.see(seen, 0)]
    return LabelledFrame(labels=labels, width=LABEL_WIDTH, height=height).drawn(picture)


def skeleton_extractors(
    extractors: Sequence[str] | None = None, *, models_dir: Path | None = None
) -> "ExtractorChoice":
    """The extractors that find a picture's skeletons; arguments as for ``first_skeleton``.

    Raises:
        ConfigError: none of them gives keypoints.
    """
    from labeling.extractors import choose_extractors

    choice = choose_extractors(extractors, models_dir=models_dir)
    if choice.draws_nothing:
        raise ConfigError(
            "there are no keypoint extractors to find the first skeleton with; give it (--skeleton FILE), or weights "
            "(--models DIR, or --extractors street for the shipped ones); `animatic models` lists them"
        )
    return choice


def ego_trajectory(source: str | Path | Trajectory, *, frames: int, fps: float) -> Trajectory:
    """A trajectory of ``frames`` poses from a recipe, a TUM or KITTI file, an (T, 4, 4) ``.npy``, or one at hand.

    Raises:
        ConfigError: neither a file nor a recipe, a ``.npy`` of something else, or the file is too short.
        TrajectoryError: poses that are none.
    """
    if isinstance(source, Trajectory):
        given = source
    elif Path(source).suffix == ".npy" and Path(source).is_file():
        poses = _poses(Path(source))
        given = rebased_trajectory(np.arange(len(poses)) / fps, poses)
    elif Path(source).is_file():
        tum = trajectory_format(Path(source)) == "tum"
        given = read_tum(Path(source)) if tum else read_kitti(Path(source), fps=fps)
    else:
        return recipe_trajectory(str(source), frames=frames, fps=fps)
    wanted = given.timestamps_s[0] + np.arange(frames) / fps
    if wanted[-1] > given.timestamps_s[-1] + 0.5 / fps:
        raise ConfigError(
            f"the trajectory lasts {given.timestamps_s[-1] - given.timestamps_s[0]:.2f} s, the clip "
            f"{(frames - 1) / fps:.2f} s; give a longer one"
        )
    return resample(given, np.minimum(wanted, given.timestamps_s[-1]))


def _poses(path: Path) -> np.ndarray:
    """(T, 4, 4) numbers of a ``.npy``; nothing is unpickled."""
    try:
        held = np.load(path, allow_pickle=False)
        found = f"{held.dtype} {held.shape}"
    # Bytes of another kind lead numpy to any of these; an archive of arrays has no type.
    except (ValueError, OSError, EOFError, MemoryError, SyntaxError, AttributeError) as error:
        raise ConfigError(
            f"{path} is no array of camera poses: it is no whole .npy of numbers; give (T, 4, 4) numbers that "
            "numpy.save wrote, or a TUM or KITTI file"
        ) from error
    if held.dtype.kind not in "fiu" or held.ndim != 3 or held.shape[1:] != (4, 4) or not len(held):
        raise ConfigError(f"{path} holds {found}, but a trajectory is (T, 4, 4) numbers: cam_to_world of each frame")
    return held


def ego_clip(trajectory: Trajectory, *, picture: PictureConfig, intrinsics: Intrinsics | None = None) -> np.ndarray:
    """(T, H, W, 3): the ego video at the controls' size; the same for training and sampling."""
    frames = ego_frames(
        trajectory, width=picture.control_width, height=picture.control_height, intrinsics=intrinsics,
        style=picture.ego_style,
    )  # fmt: skip
    return np.stack(list(frames))


def object_clip(
    source: Path, *, frames: int, picture: PictureConfig, key: str = "given", variant: int = 0
) -> np.ndarray:
    """(T, H, W, 3): an object video from an MP4, or drawn from a Parquet table of labels.

    Labels count from the clip's first frame, so that an object may enter late.

    Raises:
        ConfigError: too short, or labels that all lie behind the clip's last frame.
        VideoError: not a video.
    """
    size = {"width": picture.control_width, "height": picture.control_height}
    if source.suffix == ".parquet":
        labels = read_keypoints(source)
        span = Span(start=0, end=(frames - 1) * picture.frame_step + 1)
        first = min((label.frame for label in labels), default=0)
        if first >= span.end:
            raise ConfigError(
                f"{source}: its first label is in frame {first}, but the clip has frames 0 to {span.end - 1}; count "
                "frames from the clip's first"
            )
        return np.stack(list(object_frames(labels, clip=span, key=key, variant=variant, **size)))[:: picture.frame_step]
    return control_clip(source, frames=frames, picture=picture)


def control_clip(source: Path, *, frames: int, picture: PictureConfig) -> np.ndarray:
    """(T, H, W, 3): a control video file at the controls' size, every ``frame_step``-th frame.

    Raises:
        ConfigError: too short.
        VideoError: not a video.
    """
    found = np.stack(list(read_frames(source)))[:: picture.frame_step]
    if len(found) < frames:
        raise ConfigError(f"{source} gives {len(found)} frames, the clip needs {frames}; give a longer one")
    return fitted(found[:frames], width=picture.control_width, height=picture.control_height)

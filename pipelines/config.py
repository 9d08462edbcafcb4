"""The settings of a job: nested, strict, in YAML; and its presets, which are functions that return one."""

from collections.abc import Mapping
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

from dataset.shards import Split
from labeling.efforts import Effort
from labeling.ego_motion import EgoSettings
from labeling.ego_video import EgoRenderer, EgoStyle
from labeling.encoding import EncoderSettings, lossless_rgb
from labeling.settings_files import laid_over, parse_settings
from labeling.timeline import ClipSettings

EFFORTS: tuple[Effort, ...] = get_args(Effort)
COUNTED_CLASSES = ("car", "truck", "bus", "motorcycle", "bicycle", "person")


class Settings(BaseModel):
    """Settings know their fields, refuse others, and never change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class PictureSettings(Settings):
    """The working picture: sources are scaled to cover it and centre-cropped."""

    width: int = Field(default=1056, ge=16, multiple_of=2)
    height: int = Field(default=704, ge=16, multiple_of=2)


class CameraSettings(Settings):
    """What is known of a camera, in pixels of the source. What is not said is read from the file's metadata, else
    estimated from the video, else assumed."""

    fx: float | None = Field(default=None, ge=1, le=1e6, allow_inf_nan=False)
    fy: float | None = Field(default=None, ge=1, le=1e6, allow_inf_nan=False)
    """By default as ``fx``."""
    cx: float | None = Field(default=None, ge=-1e5, le=1e5, allow_inf_nan=False)
    """By default the picture's middle, as ``cy``."""
    cy: float | None = Field(default=None, ge=-1e5, le=1e5, allow_inf_nan=False)
    focal_sigma: float = Field(default=0.01, ge=0, lt=1)
    """One sigma of the focal length, relative to it."""
    height_m: float | None = Field(default=None, ge=0.01, le=1000, allow_inf_nan=False)
    """Over the road; metric scale is proportional to it."""
    pitch_deg: float | None = Field(default=None, gt=-45, lt=45)
    """Against the road, positive looks down."""

    @model_validator(mode="after")
    def _complete(self) -> "CameraSettings":
        if self.fx is None and self.fy is not None:
            raise ValueError("fy is given without fx; give fx, or both")
        if (self.cx is None) != (self.cy is None):
            raise ValueError("cx and cy go together; give both or neither")
        return self


class CountSettings(Settings):
    """How objects are counted, on the source's own keyframes."""

    detector: str | None = None
    """A model card's name; by default the first detector whose weights are there."""
    looks_per_clip: int = Field(default=2, ge=1)
    """Frames to look at in each clip; where keyframes are rarer, others are sought out."""
    threads: int = Field(default=1, ge=1)
    providers: tuple[str, ...] = ("CPUExecutionProvider",)
    """As those of ``keypoints``."""


class SelectSettings(Settings):
    """Which clips are kept, and which split they go to."""

    keep_share: float = Field(default=0.5, gt=0, le=1)
    """Share of the clips with the most objects; ties at the threshold are kept. 1 keeps every clip uncounted."""
    classes: tuple[str, ...] | Literal["cars"] = COUNTED_CLASSES
    """What counts as an object; ``cars`` is the released rule."""
    min_score: float = Field(default=0.3, ge=0, le=1)
    """Detections that score less do not count."""
    seed: int = 0
    sample_clips: int | None = Field(default=None, ge=1)
    """How many of the kept clips to take, by rank of hash(seed, key); all by default."""
    val_share: float = Field(default=0.1, ge=0, lt=1)
    """Share of the source videos that go to val, by hash(seed, video id)."""
    split: dict[str, Split] | None = None
    """The split of each video by name, instead of the hash (``--split FILE``)."""

    @property
    def counted_classes(self) -> tuple[str, ...]:
        """Class names that count."""
        return ("car",) if self.classes == "cars" else self.classes


class KeypointSettings(Settings):
    """How keypoints are extracted and tracked."""

    extractors: tuple[str, ...] | None = None
    """Card names, or ``street`` for the small shipped models; by default every card whose weights are there, the
    street models aside."""
    effort: Effort = "balanced"
    threads: int = Field(default=1, ge=1)
    providers: tuple[str, ...] = ("CPUExecutionProvider",)
    """Execution providers in order; a missing one is an error, never a silent CPU."""


class EgoStageSettings(Settings):
    """How the camera's motion is estimated."""

    camera_height_m: float = Field(default=1.5, ge=0.01, le=1000, allow_inf_nan=False)
    """Assumed of cameras of which no height is given."""
    motion: EgoSettings = EgoSettings()


class ViewSettings(Settings):
    """The control videos and captions."""

    width: int = Field(default=768, ge=16, multiple_of=2)
    height: int = Field(default=512, ge=16, multiple_of=2)
    skeleton_encoder: EncoderSettings = lossless_rgb()
    """Lossless, in RGB: 4:2:0 loses the skeletons' colours."""
    view_encoder: EncoderSettings = EncoderSettings()
    """For ego and object videos."""
    ego_style: EgoStyle = "world"
    ego_renderer: EgoRenderer = "remap"
    ego_seed: int = 0
    object_variant: int = 0
    """Another number chooses other tracks."""
    captions: str | None = None
    """A table of key and text; clips that it lacks get the template's caption."""


class PackSettings(Settings):
    """How samples are packed."""

    shard_bytes: int = Field(default=750_000_000, ge=1)
    """Shards are filled up to this size."""
    videos: Literal["all", "rgb"] = "all"
    """``rgb`` leaves the three views out: they can be drawn again from labels."""


class Config(Settings):
    """All settings of a job."""

    clip: ClipSettings = ClipSettings()
    picture: PictureSettings = PictureSettings()
    camera: CameraSettings | None = None
    """Of every video."""
    cameras: dict[str, CameraSettings] = {}
    """By video id: what they say goes before ``camera`` (``--cameras FILE``)."""
    encoder: EncoderSettings = EncoderSettings()
    count: CountSettings = CountSettings()
    select: SelectSettings = SelectSettings()
    keypoints: KeypointSettings = KeypointSettings()
    ego: EgoStageSettings = EgoStageSettings()
    views: ViewSettings = ViewSettings()
    pack: PackSettings = PackSettings()

    @model_validator(mode="after")
    def _strides_fall_on_keyframes(self) -> "Config":
        for name, encoder in (("encoder", self.encoder), ("views.skeleton_encoder", self.views.skeleton_encoder)):
            if self.clip.stride_frames % encoder.gop or self.clip.run_frames % self.clip.stride_frames:
                raise ValueError(
                    f"{name}.gop {encoder.gop} must divide clip.stride_frames {self.clip.stride_frames}, "
                    f"and that clip.run_frames {self.clip.run_frames}: clips are cut at keyframes"
                )
        return self


def video_camera(config: Config, video_id: str) -> CameraSettings:
    """What is known of one video's camera: its own settings, before those of all videos."""
    common = (config.camera or CameraSettings()).model_dump(exclude_none=True)
    own = config.cameras.get(video_id, CameraSettings()).model_dump(exclude_none=True)
    if "fx" in own:
        common.pop("fy", None)
    else:
        own.pop("focal_sigma")
    return CameraSettings(**{**common, **own})


def with_effort(config: Config, effort: Effort) -> Config:
    """``config`` at another point of the fronts of speed against accuracy."""
    looks = {"fast": 1, "balanced": 2, "exact": 8}[effort]
    return merged(config, {"count": {"looks_per_clip": looks}, "keypoints": {"effort": effort}})


def merged(config: Config, changes: Mapping[str, Any]) -> Config:
    """``config`` with nested changes.

    Raises:
        ConfigError: a change that no setting allows.
    """
    return parse_config(laid_over(config.model_dump(mode="json"), changes), "settings")


def parse_config(values: Mapping[str, Any], name: str) -> Config:
    """A configuration from plain values; what is not given has its default.

    Raises:
        ConfigError: an unknown key, or a value out of range, with its path.
    """
    return parse_settings(Config, values, name)

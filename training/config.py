"""What a training run is told: nested pydantic models, named recipes as YAML in ``configs/``, unknown keys refused.

The recipes are the paper's (MAD, arXiv 2601.09452, section 4): AdamW 2e-4, betas (0.9, 0.95), global batch 32, 9,000
motion steps under a cosine, 5,000 appearance steps under a line, LoRA of rank 512.
"""

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from labeling.errors import ConfigError
from labeling.settings_files import laid_over, parse_settings, read_yaml

Stage = Literal["motion", "appearance", "end_to_end"]
STAGES: tuple[Stage, ...] = ("motion", "appearance", "end_to_end")
Convention = Literal["consistent", "released"]
"""Of coordinates and of the shift of noise levels: as this project has them, or as the released code."""
Formula = Literal["variance", "blend"]
"""Of targeted noise; see ``training.targeted_noise``."""
_LONGEST_NAME = 200
"""Bytes: file systems take 255, and the stage's name is added."""
CONFIG_FOLDER = Path(__file__).with_name("configs")


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)


def _one_folder(name: str) -> str:
    if name.startswith(".") or set(name) & {"/", "\\", "\0"} or len(name.encode()) > _LONGEST_NAME:
        raise ValueError(
            f"names a folder, so it must have no slash, not begin with a dot, and be {_LONGEST_NAME} bytes at most"
        )
    return name


FolderName = Annotated[str, AfterValidator(_one_folder)]
"""Text that is the name of one folder, and leads nowhere else."""
Seed = Annotated[int, Field(ge=0, lt=2**63)]
"""What torch's and numpy's generators both take."""


class PictureConfig(_Settings):
    """Sizes and frames that the latents are made at; part of the cache's fingerprint."""

    control_width: int = 768
    """Columns of the skeleton, ego and object videos, in pixels."""
    control_height: int = 512
    rgb_width: int = 1056
    """Columns of the RGB target, in pixels."""
    rgb_height: int = 704
    frames: int | None = None
    """Frames taken of each clip, from its first; None takes the whole clip."""
    frame_step: int = Field(default=1, ge=1)
    """Every n-th frame of the clip: 2 makes 12 fps of 24."""
    clip_fps: float = 24.0
    """Frame rate of the clips in the shards."""
    ego_style: Literal["world", "released"] = "world"
    """``released`` for the released adapters only."""

    @property
    def fps(self) -> float:
        """Frame rate that the backbone sees."""
        return self.clip_fps / self.frame_step

    @property
    def rate(self) -> Fraction:
        """``fps`` as videos are written."""
        return exact_rate(self.fps)


def exact_rate(fps: float) -> Fraction:
    """The frame rate behind a float: 24/7 of 3.428..., 24000/1001 of 23.976..."""
    return Fraction(fps).limit_denominator(1001)


class BackboneConfig(_Settings):
    """Which network, where its weights are, and at what sizes it works. ``name`` alone picks a preset."""

    name: FolderName = Field(min_length=1)
    """Also the folder of its latents in a job: ``latents/<name>``."""
    kind: Literal["tiny", "ltx", "svd", "tiny_svd"]
    size: Literal["tiny", "2b", "13b", "svd"] = "tiny"
    weights: str | None = None
    """Local folder, single safetensors file, or hub id, which is looked for in the hub's cache and never downloaded;
    None only for the tiny kinds (random, from ``seed``)."""
    weights_config: str | None = None
    """For a single file: the folder or hub id whose ``transformer`` and ``vae`` configurations fit. None lets
    diffusers tell by the file's keys, and needs them in the hub's cache."""
    text_weights: str | None = None
    """Text encoder and tokenizer, where they are not part of ``weights``."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Of the frozen weights; adapters are always float32."""
    latent_dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    """Of the cached latents."""
    text_width: int = 4096
    """Channels of the text encoder; what SVD's text projection is sized by."""
    text_tokens: int = 128
    """Captions are cut and padded to this many tokens."""
    vae_tiling: bool = False
    seed: Seed = 0
    """Of the random weights of the tiny kinds."""
    picture: PictureConfig = PictureConfig()

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, value: Any) -> Any:
        if isinstance(value, str):
            value = {"name": value}
        if isinstance(value, Mapping) and "kind" not in value and value.get("name") in BACKBONES:
            return laid_over(BACKBONES[value["name"]] | {"name": value["name"]}, value)
        if isinstance(value, Mapping) and "kind" not in value and "name" in value:
            raise ValueError(f"not a preset; choose one of {', '.join(BACKBONES)}, or say its kind")
        return value


BACKBONES: dict[str, dict[str, Any]] = {
    "tiny": {
        "kind": "tiny",
        "picture": {"control_width": 192, "control_height": 128, "rgb_width": 192, "rgb_height": 128},
    },
    "tiny-svd": {
        "kind": "tiny_svd", "text_width": 32,
        "picture": {
            "control_width": 96, "control_height": 64, "rgb_width": 96, "rgb_height": 64, "frames": 5, "frame_step": 2,
        },
    },
    "ltx-2b": {
        "kind": "ltx", "size": "2b", "weights": "Lightricks/LTX-Video",
        "dtype": "bfloat16", "latent_dtype": "bfloat16",
    },
    "ltx-13b": {
        "kind": "ltx", "size": "13b", "weights": "Lightricks/LTX-Video-0.9.7-dev",
        "dtype": "bfloat16", "latent_dtype": "bfloat16",
    },
    "svd": {
        "kind": "svd", "size": "svd", "weights": "stabilityai/stable-video-diffusion-img2vid-xt",
        "text_weights": "google/t5-v1_1-large", "text_width": 1024, "dtype": "bfloat16", "latent_dtype": "bfloat16",
        "picture": {
            "control_width": 768, "control_height": 512, "rgb_width": 768, "rgb_height": 512,
            "frames": 25, "frame_step": 2,
        },
    },
}  # fmt: skip
"""Presets by name."""


class AdapterConfig(_Settings):
    """The LoRA that is trained (Hu et al. 2021)."""

    rank: int = Field(default=512, ge=1, le=16384)
    """More than the widest layer of the backbones has, 16,384, would add nothing but memory."""
    alpha: float | None = None
    """Scale is alpha / rank; None means alpha = rank."""
    targets: tuple[str, ...] = ("to_k", "to_q", "to_v", "to_out.0", "ff.net.0.proj", "ff.net.2")
    """Module name endings."""
    dropout: float = Field(default=0.0, ge=0, lt=1)

    @property
    def lora_alpha(self) -> float:
        """alpha, or the rank where none is given."""
        return float(self.rank if self.alpha is None else self.alpha)


class ConditionsConfig(_Settings):
    """What a sample is conditioned on, each with its own probability; all draws are independent."""

    control: str = "skeleton"
    """The intermediate representation: ``skeleton`` or the name of any control video in the shards."""
    ego_probability: float = Field(default=0.5, ge=0, le=1)
    objects_probability: float = Field(default=0.5, ge=0, le=1)
    caption_dropout: float = Field(default=0.1, ge=0, le=1)
    """Share of samples that see the empty caption, since sampling uses guidance."""
    coordinates: Convention = "consistent"
    """``released`` is for sampling with the released adapters only."""


class TargetedNoiseConfig(_Settings):
    """Noise on the lit cells of the appearance stage's skeleton latents (the paper's eq. for z + sqrt(omega) eps)."""

    omega_max: float = Field(default=0.3, ge=0, le=1)
    """omega ~ U(0, omega_max) per sample; 0 switches it off."""
    formula: Formula = "variance"


_Momentum = Annotated[float, Field(ge=0, lt=1)]


class OptimiserConfig(_Settings):
    """AdamW and its schedule, counted in optimiser steps."""

    learning_rate: float = Field(default=2e-4, gt=0)
    betas: tuple[_Momentum, _Momentum] = (0.9, 0.95)
    weight_decay: float = Field(default=0.01, ge=0)
    epsilon: float = Field(default=1e-8, ge=0)
    steps: int = Field(ge=1)
    global_batch: int = Field(default=32, ge=1)
    """Samples per optimiser step over all processes."""
    micro_batch: int = Field(default=1, ge=1)
    """Samples per process and backward pass; accumulation follows from it."""
    schedule: Literal["cosine", "linear", "constant"] = "cosine"
    warmup_steps: int = Field(default=0, ge=0)
    final_factor: float = Field(default=0.0, ge=0, le=1)
    """Learning rate of the last step over the peak."""
    max_gradient_norm: float | None = Field(default=1.0, ge=0)
    """Gradients are clipped to this norm; None or 0 leaves them as they are."""


class CheckpointConfig(_Settings):
    """When to save, and how many to keep."""

    every_steps: int = Field(default=500, ge=1)
    keep: int = Field(default=3, ge=1)


_Share = Annotated[float, Field(gt=0, le=1)]


def _some(levels: tuple[float, ...]) -> tuple[float, ...]:
    if not levels:
        raise ValueError("holds no noise level; give one, or set loss_every_steps to 0")
    return levels


class ValidationConfig(_Settings):
    """Held-out loss and validation videos."""

    loss_every_steps: int = Field(default=250, ge=0)
    """0 switches it off."""
    sigmas: Annotated[tuple[_Share, ...], AfterValidator(_some)] = (0.1, 0.3, 0.5, 0.7, 0.9)
    """Fixed noise levels, so that curves compare; shares of the way to pure noise."""
    clips: int = Field(default=8, ge=1)
    videos_every_steps: int = Field(default=0, ge=0)
    """0 switches them off."""
    video_clips: int = Field(default=2, ge=1)
    sampling_steps: int = Field(default=30, ge=1)
    guidance: float = 3.0


class TrainConfig(_Settings):
    """One training run."""

    name: FolderName = ""
    """Also the folder of its adapter in a job, where no other is given: ``adapters/<name>_<stage>``."""
    stage: Stage
    backbone: BackboneConfig
    adapter: AdapterConfig = AdapterConfig()
    conditions: ConditionsConfig = ConditionsConfig()
    targeted_noise: TargetedNoiseConfig = TargetedNoiseConfig()
    optimiser: OptimiserConfig
    checkpoint: CheckpointConfig = CheckpointConfig()
    validation: ValidationConfig = ValidationConfig()
    seed: Seed = 0
    gradient_checkpointing: bool = True
    compile: bool = False
    """torch.compile of the transformer's blocks."""
    loader_workers: int = Field(default=2, ge=0)
    trackers: tuple[str, ...] = ("tensorboard",)
    """Names that accelerate knows: tensorboard, wandb, ..."""
    log_every_steps: int = Field(default=1, ge=1)

    @field_validator("conditions")
    @classmethod
    def _trainable_coordinates(cls, value: ConditionsConfig) -> ConditionsConfig:
        if value.coordinates == "released":
            raise ValueError("coordinates: released is for sampling only (the released training used 8f/fps)")
        return value


def config_names() -> list[str]:
    """The recipes that ship, by name."""
    return sorted(path.stem for path in CONFIG_FOLDER.glob("*.yaml"))


def backbone_config(name_or_path: str | Path, **overrides: Any) -> BackboneConfig:
    """A backbone by preset name, or from a YAML file of its fields; ``overrides`` replace single fields.

    Raises:
        ConfigError: no such preset or file, a file that cannot be read or is no YAML, an unknown key, a value of the
            wrong kind.
    """
    if str(name_or_path) in BACKBONES:
        tree: dict[str, Any] = {"name": str(name_or_path)}
    elif Path(name_or_path).is_file():
        tree = read_yaml(Path(name_or_path))
        tree = (
            tree.get("backbone", tree) if isinstance(tree.get("backbone", tree), dict) else {"name": tree["backbone"]}
        )
    else:
        raise ConfigError(
            f"backbone {str(name_or_path)!r} is not known; choose one of {', '.join(BACKBONES)} or a file"
        )
    return parse_settings(BackboneConfig, laid_over(tree, overrides), str(name_or_path))


def load_config(
    name_or_path: str | Path, *, stage: Stage | None = None, overrides: Mapping[str, Any] | None = None
) -> TrainConfig:
    """A recipe by name or path.

    Args:
        name_or_path: ``motion_ltx_2b``, ``tiny``, or a YAML file.
        stage: which adapter; needed where the file names none, refused where it names another.
        overrides: a nested mapping laid over the file.

    Raises:
        ConfigError: no such recipe, a file that cannot be read or is no YAML, an unknown key, a wrong value, stages
            that disagree.
    """
    path = Path(name_or_path)
    if not path.is_file():
        path = CONFIG_FOLDER / f"{name_or_path}.yaml"
    if not path.is_file():
        raise ConfigError(
            f"no training config {str(name_or_path)!r}; give a YAML file or one of {', '.join(config_names())}"
        )
    tree = read_yaml(path)
    if isinstance(tree.get("backbone"), str):
        tree["backbone"] = {"name": tree["backbone"]}
    tree = laid_over(tree, overrides or {})
    if stage is not None and tree.setdefault("stage", stage) != stage:
        raise ConfigError(
            f"{path.name} trains stage {tree['stage']!r}, but {stage!r} was asked for; take another config"
        )
    if not tree.get("name"):
        tree["name"] = path.stem
    return parse_settings(TrainConfig, tree, path.name)

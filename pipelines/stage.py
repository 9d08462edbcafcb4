"""What a stage is: a pure plan of items with their inputs, and a function that makes one item in a staging folder."""

import functools
import importlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

from dataset.receipts import Receipt, digest, hashed_share, outputs_present
from labeling.errors import AnimaticError, ConfigError

if TYPE_CHECKING:
    from pipelines.job import Job

STAGES: dict[str, str] = {
    "source": "pipelines.stages_source:SourceStage",
    "index": "pipelines.stages_source:IndexStage",
    "count": "pipelines.stages_select:CountStage",
    "select": "pipelines.stages_select:SelectStage",
    "cut": "pipelines.stages_source:CutStage",
    "keypoints": "pipelines.stages_labels:KeypointsStage",
    "corners": "pipelines.stages_ego:CornersStage",
    "camera": "pipelines.stages_ego:CameraStage",
    "ego": "pipelines.stages_ego:EgoStage",
    "skeleton": "pipelines.stages_views:SkeletonStage",
    "render": "pipelines.stages_views:RenderStage",
    "pack": "pipelines.stages_pack:PackStage",
    "shards": "pipelines.stages_pack:ShardIndexStage",
}
"""Where each stage lives, in the order in which they run. Nothing is imported before it is asked for."""

COMMAND_STAGES: dict[str, tuple[str, ...]] = {
    "index": ("source", "index"),
    "count": ("count",),
    "select": ("select",),
    "cut": ("cut",),
    "keypoints": ("keypoints",),
    "ego": ("corners", "camera", "ego"),
    "render": ("skeleton", "render"),
    "pack": ("pack", "shards"),
}
"""What a person calls a stage, and what runs for it."""


EXTRA_STAGES_VARIABLE = "ANIMATIC_EXTRA_STAGES"


class NotReadyError(AnimaticError):
    """A barrier: another part of the job has not come as far."""

    reason: ClassVar[str] = "waiting"
    retryable: ClassVar[bool] = True


class DroppedError(Exception):
    """Raised by a stage's work: the item is left out, for a reason that carries its numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkItem:
    """One unit of work: everything its outputs depend on, and what they are called."""

    stage: str
    name: str
    """``<video_id>``, ``<video_id>/run_<start>_<end>``, a clip's key or a shard's name."""
    owner: str
    """What decides the part that works on it: the video's id, or the shard's name."""
    version: int
    """Of the stage's code: raised when the same inputs give other outputs."""
    settings: dict[str, Any]
    """All settings that the outputs depend on, as JSON values."""
    inputs: dict[str, Any]
    """Content hashes and spans."""
    models: dict[str, str] = field(default_factory=dict)
    """sha256 of the weights, by card name."""
    outputs: tuple[str, ...] = ()
    """Paths relative to the job, of which the base names are unique."""
    payload: dict[str, Any] = field(default_factory=dict)
    """Where to find things: paths. Outputs do not depend on it."""
    weight: float = 1.0
    """How much work it is, relative to others of its stage (for the progress bar)."""

    @property
    def key(self) -> str:
        """Digest of everything the outputs depend on."""
        return digest([self.stage, self.version, self.settings, self.inputs, self.models, self.outputs])


class Stage(Protocol):
    """A stage: plans from what receipts say, works on one item at a time, in any process."""

    name: str

    def plan(self, job: "Job") -> list[WorkItem]:
        """Every item that should exist, in order; items whose inputs are not there yet are left out.

        Raises:
            NotReadyError: the stage needs all of an earlier stage, and some of it is still to be done.
        """
        ...

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Make the item's outputs in ``staging``, under their base names, and return small facts about them.

        Raises:
            DroppedError: the item is left out.
            AnimaticError: it failed.
        """
        ...


ItemState = Literal["current", "missing", "stale", "retry"]


def item_state(item: WorkItem, receipt: Receipt | None, root: Path) -> ItemState:
    """Whether an item is up to date, was never made, depends on something that changed, or failed for the moment."""
    if receipt is None:
        return "missing"
    if receipt.key != item.key:
        return "stale"
    if receipt.state == "failed" and receipt.retryable:
        return "retry"
    if receipt.state == "done" and not outputs_present(root, receipt):
        return "missing"
    return "current"


@functools.cache
def load_stage(name: str) -> Stage:
    """The stage called ``name``.

    Raises:
        ConfigError: there is none.
    """
    known = {**STAGES, **_extra_stages()}
    if name not in known:
        raise ConfigError(f"stage {name!r} is not known; choose one of {', '.join(known)}")
    module, _, attribute = known[name].partition(":")
    return getattr(importlib.import_module(module), attribute)()


def _extra_stages() -> dict[str, str]:
    """Stages of one's own, ``name=module:Class`` with commas between, which worker processes must find too."""
    pairs = (entry.partition("=") for entry in os.environ.get(EXTRA_STAGES_VARIABLE, "").split(",") if entry)
    return {name: place for name, _, place in pairs}


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A host's share of the videos: those whose hash falls to it. 1-based."""

    index: int = 1
    count: int = 1

    def owns(self, owner: str) -> bool:
        """Whether an item belongs to this part."""
        return self.count == 1 or int(hashed_share("part", owner) * self.count) == self.index - 1

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


def parse_part(text: str) -> Part:
    """``i/n`` as a part.

    Raises:
        ConfigError: it is not two numbers with 1 <= i <= n.
    """
    index, slash, count = text.partition("/")
    if slash and index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count):
        return Part(index=int(index), count=int(count))
    raise ConfigError(f"--part {text!r} is no share; give i/n with 1 <= i <= n, as 2/8")

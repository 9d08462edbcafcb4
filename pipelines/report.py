"""``report.html``: a job on one page that needs nothing beside it; pictures, videos and numbers are inside."""

import base64
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import cv2
import jinja2
import numpy as np
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dataset.contact_sheet import SHEET_ROWS, contact_sheet
from dataset.inspection import Summary, find_sample, summarize
from dataset.layout import REPORT, SELECTION, SHARD_INDEX
from dataset.loader import Sample, ShardDataset
from dataset.receipts import atomic_write
from dataset.selection import Selection, read_selection
from labeling.encoding import EncoderSettings, VideoWriter
from labeling.errors import DataError
from pipelines.console import duration, file_size
from pipelines.job import open_job
from pipelines.status import JobStatus, failure_lines, job_status, videos_words

_TEMPLATE = Path(__file__).with_name("templates") / "report.html"
_QUARTER = (384, 256)
_ACCENT, _GREY, _PAPER = "#c2410c", "#94a3b8", "#ffffff"


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A figure of the page, inside its HTML."""

    kind: Literal["image", "video"] = "image"
    data: str
    """A ``data:`` address."""
    caption: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PageTable:
    """A table of the page."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Sequence[int] = ()
    """Columns set to the right."""
    bad: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A part of the page, in the order: text, pictures, tables, code."""

    title: str
    text: str = ""
    pictures: Sequence[Picture] = ()
    tables: Sequence[PageTable] = ()
    code: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportExtras:
    """What a caller adds to a job's report."""

    title: str = ""
    sections: Sequence[Section] = ()
    """After the labels, before the settings."""
    cards: Mapping[str, str] = field(default_factory=dict)


def write_report(root: Path, *, out: Path | None = None, extras: ReportExtras | None = None) -> Path:
    """Write a job's report; its path.

    Raises:
        ConfigError: no job there.
        DataError: the job has no selection yet.
        StorageError: it cannot be written.
    """
    extras = extras or ReportExtras()
    status, summary = job_status(root), summarize(root)
    page = jinja2.Environment(autoescape=True).from_string(_TEMPLATE.read_text(encoding="utf-8"))
    html = page.render(
        title=extras.title or f"Animatic: {root.name}",
        subtitle=f"{videos_words(root, summary)}, {summary.source_hours:.3g} h, labelled by animatic {_version()}",
        cards=[{"name": name, "value": value} for name, value in {**_cards(summary), **extras.cards}.items()],
        sections=[*_label_sections(root, status, summary), *extras.sections, _settings_section(root)],
        footer=f"next: {status.next_command} ({status.next_reason})",
    )
    path = out or root / REPORT
    atomic_write(path, html.encode())
    return path


def _version() -> str:
    try:
        return version("animatic")
    except PackageNotFoundError:
        return "(not installed)"


def _cards(summary: Summary) -> dict[str, str]:
    metres = summary.path_length_m
    return {
        "clips packed": str(sum(summary.packed.values())),
        "clips kept of all": f"{summary.kept} / {summary.clips}",
        "of video in clips": duration(summary.clip_hours * 3600),
        "median path": f"{metres.median:.0f} m" if metres else "none",
        "in shards": file_size(sum(summary.bytes_by_kind.values())),
    }


def _label_sections(root: Path, status: JobStatus, summary: Summary) -> list[Section]:
    sections = []
    if sum(summary.packed.values()):
        sample = find_sample(root)
        sections.append(
            Section(
                title="One clip in its four videos", text=sample.caption,
                pictures=[Picture(kind="video", data=four_videos(sample), caption=f"{sample.key}: {_names(sample)}")],
            )
        )  # fmt: skip
        sections.append(
            Section(
                title="Clips at a glance",
                pictures=[
                    Picture(data=png_data(contact_sheet(clip)), caption=f"{clip.key}: four moments")
                    for clip in _some_clips(root)
                ],
            )
        )
    pictures = [
        Picture(data=png_data(draw_objects(read_selection(root / SELECTION))), caption="Objects per clip, counted on "
                "keyframes; what lies left of the line was dropped"),
        Picture(data=png_data(draw_trajectories(root)), caption="Where the cameras of the packed clips go, from above"),
    ]  # fmt: skip
    sections.append(Section(title="Selection and motion", pictures=pictures))
    sections.append(Section(title="Stages", tables=[_stage_table(root, status)]))
    failures = failure_lines(root)
    if failures:
        rows = [line.split(": ", 2) for line in failures]
        table = PageTable(columns=("stage", "item", "why"), rows=rows, bad=True)
        sections.append(Section(title="What failed", tables=[table]))
    return sections


def _names(sample: Sample) -> str:
    return ", ".join(name for suffix, name in SHEET_ROWS.items() if suffix in sample.members)


def _some_clips(root: Path, most: int = 1) -> list[Sample]:
    """Clips from the far end, so that they are others than the first."""
    samples = [sample for split in ("train", "val") for sample in ShardDataset(root, split)]
    return samples[-most:]


def _stage_table(root: Path, status: JobStatus) -> PageTable:
    rows, job = [], open_job(root)
    for stage in status.stages:
        receipts = job.settled(stage.stage).values() if stage.items is not None else ()
        frames = sum(receipt.facts.get("frames", 0) for receipt in receipts if receipt.state == "done")
        seconds = sum(receipt.seconds for receipt in receipts)
        lost = [f"{count} {reason}" for reason, count in {**stage.dropped, **stage.failed, **stage.retryable}.items()]
        per_frame = f"{1000 * seconds / frames:.1f}" if frames and stage.stage not in ("index", "source") else ""
        rows.append(
            (stage.stage, str(stage.items if stage.items is not None else "?"), str(stage.done), duration(seconds),
             per_frame, ", ".join(lost))
        )  # fmt: skip
    columns = ("stage", "items", "done", "worker time", "ms per frame", "dropped or failed")
    return PageTable(columns=columns, rows=rows, numbers=(1, 2, 3, 4))


def _settings_section(root: Path) -> Section:
    job = open_job(root)
    values = job.config.model_dump(mode="json", exclude_defaults=True)
    text = yaml.safe_dump(values, sort_keys=True) if values else "# all settings have their defaults\n"
    return Section(title="Settings", text="What differs from the defaults.", code=text.rstrip())


def four_videos(sample: Sample) -> str:
    """A clip's videos in one picture, two by two, as H.264 in a ``data:`` address (browsers show no RGB H.264)."""
    suffixes = [suffix for suffix in SHEET_ROWS if suffix in sample.members]
    streams = [sample.iterate_frames(suffix) for suffix in suffixes]
    return mp4_data([tiled(frames) for frames in zip(*streams, strict=True)])


def tiled(frames: Sequence[np.ndarray]) -> np.ndarray:
    """Up to four pictures, two by two."""
    width, height = _QUARTER
    shrunk = [cv2.resize(frame, _QUARTER, interpolation=cv2.INTER_AREA) for frame in frames]
    blank = np.zeros((height, width, 3), np.uint8)
    rows = [np.concatenate([left, right if right is not None else blank], axis=1)
            for left, right in zip_longest(shrunk[::2], shrunk[1::2])]  # fmt: skip
    return np.concatenate(rows, axis=0)


def mp4_data(frames: Sequence[np.ndarray], *, fps: int = 24, crf: int = 30) -> str:
    """Frames as an H.264 video in a ``data:`` address; ``crf`` bounds its size.

    Raises:
        DataError: no frames.
    """
    if not frames:
        raise DataError("a video needs frames; this is a fault of the report, please report it")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        height, width = frames[0].shape[:2]
        with VideoWriter(
            path, width=width, height=height, fps=fps, settings=EncoderSettings(crf=crf, preset="medium")
        ) as writer:
            for frame in frames:
                writer.write(frame)
        return "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode()


def png_data(picture: np.ndarray) -> str:
    """(H, W, 3) uint8 RGB as a ``data:`` address: PNG, or JPEG where that is much smaller (photographs)."""
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    kinds = {"png": cv2.imencode(".png", bgr)[1], "jpeg": cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 88])[1]}
    kind = "jpeg" if len(kinds["png"]) > 2 * len(kinds["jpeg"]) else "png"
    return f"data:image/{kind};base64," + base64.b64encode(kinds[kind].tobytes()).decode()


def new_axes(*, width: float = 6.2, height: float = 4.0) -> tuple[Figure, Any]:
    """A plain figure on white and its axes."""
    figure = Figure(figsize=(width, height), dpi=130, layout="constrained", facecolor=_PAPER)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, alpha=0.18)
    return figure, axes


def figure_pixels(figure: Figure) -> np.ndarray:
    """(H, W, 3) uint8 RGB."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _legend_above(axes: Any) -> None:
    axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0)


def draw_objects(selection: Selection) -> np.ndarray:
    """How many objects the clips show, and where the threshold lies."""
    figure, axes = new_axes()
    counts = np.array([row.objects for row in selection.rows if row.objects is not None], dtype=float)
    if len(counts):
        edges = bin_edges(counts, at=selection.threshold or 0.0)
        kept = counts >= (selection.threshold or 0)
        axes.hist([counts[kept], counts[~kept]], bins=edges, stacked=True, color=[_ACCENT, _GREY],
                  label=["kept", "dropped"])  # fmt: skip
        if selection.threshold is not None:
            axes.axvline(selection.threshold, color="#1e293b", linewidth=1, linestyle="--")
        _legend_above(axes)
    else:
        axes.text(0.5, 0.5, "every clip is kept, so nothing was counted", ha="center", transform=axes.transAxes)
    axes.set_xlabel("objects per clip")
    axes.set_ylabel("clips")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    return figure_pixels(figure)


def bin_edges(counts: np.ndarray, *, at: float, most: int = 30) -> np.ndarray:
    """Edges of a histogram of (N,) mean counts, halves or whole numbers apart, one of them at ``at``.

    No bin then has both sides of a threshold in it.
    """
    step = max(0.5, np.ceil(2 * float(np.ptp(counts)) / most) / 2)
    first, last = np.floor((counts.min() - at) / step), np.floor((counts.max() - at) / step) + 1
    return at + step * np.arange(first, last + 1)


def draw_trajectories(root: Path, *, most: int = 200) -> np.ndarray:
    """Clips' trajectories in the ground plane, each from its first camera."""
    figure, axes = new_axes()
    samples = [sample for split in ("train", "val") for sample in ShardDataset(root, split)] if _packed(root) else []
    for number, sample in enumerate(samples[:most]):
        path = sample.cam_to_world[:, :3, 3]
        axes.plot(path[:, 2], -path[:, 0], linewidth=1.4, alpha=0.8, color=_ACCENT if number == 0 else None)
    axes.set_xlabel("ahead, m")
    axes.set_ylabel("to the left, m")
    axes.set_aspect("equal", adjustable="datalim")
    return figure_pixels(figure)


def _packed(root: Path) -> bool:
    return (root / SHARD_INDEX).is_file()


def draw_losses(curves: Mapping[str, Sequence[float]]) -> np.ndarray:
    """Training losses, step by step, with a running mean."""
    figure, axes = new_axes()
    for (name, losses), colour in zip(curves.items(), (_ACCENT, "#0369a1", "#4d7c0f"), strict=False):
        steps = np.arange(1, len(losses) + 1)
        axes.plot(steps, losses, color=colour, alpha=0.3, linewidth=1)
        span = max(1, min(9, len(losses) // 4))
        smooth = np.convolve(losses, np.ones(span) / span, mode="valid")
        axes.plot(steps[span - 1 :], smooth, color=colour, linewidth=2, label=name)
    axes.set_xlabel("step")
    axes.set_ylabel("loss")
    _legend_above(axes)
    return figure_pixels(figure)

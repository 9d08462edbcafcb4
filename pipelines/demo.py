"""``animatic demo``: the main job on the synthetic street, from videos to two adapters and one two-stage sample.

The street's truth is known, so the page that it ends with says how far the labels are from it.
"""

import json
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.table import Table

from dataset.contact_sheet import contact_sheet
from dataset.inspection import clip_record, find_sample, summarize
from dataset.loader import Sample, ShardDataset
from dataset.pictures import write_picture
from dataset.receipts import atomic_write, make_folder
from dataset.street import Scenario, Street, StreetConfig, write_street_video
from dataset.street_labels import StreetObject
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.video import read_frames
from pipelines.commands import JobOptions, run_label
from pipelines.console import duration, make_console
from pipelines.engine import minding_workers
from pipelines.keypoint_errors import match_frames
from pipelines.report import (
    PageTable,
    Picture,
    ReportExtras,
    Section,
    draw_losses,
    mp4_data,
    png_data,
    tiled,
    write_report,
)

BACKBONE = "tiny"
TRAIN_STEPS = 40
_SECONDS = 11
_LOOK_EVERY = 24
_STREETS: dict[str, tuple[Scenario, int]] = {
    "avenue": ("traffic", 11), "market": ("crossing", 12), "country": ("empty", 13), "bend": ("turn", 14),
}  # fmt: skip
"""Scenario and seed by video id."""
_SETTINGS = {
    "select": {"keep_share": 0.5, "split": {name: "val" if name == "market" else "train" for name in _STREETS}},
    "keypoints": {"extractors": ["street"]},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthFigures:
    """How far the labels of some clips are from the street's truth."""

    car_recall: float
    """Of cars at least 32 px high and 30 % visible, found with an overlap of 0.3 by a label that no other car has."""
    car_precision: float
    """Of labelled cars, those that are a true one, found so; what is none, but lower than 32 px or on a car that is not
    looked for, is left out."""
    cars: int
    """True cars that were looked for."""
    point_error_px: float
    """Median over the visible points of found cars."""
    position_error_m: float
    """Mean displacement of the camera over the clips, not aligned."""
    path_m: float
    """Mean length of the true paths."""


def street_config(video_id: str) -> StreetConfig:
    """The street of one of the demo's videos."""
    scenario, seed = _STREETS[video_id]
    return StreetConfig(seed=seed, scenario=scenario, frames=24 * _SECONDS)


def run_demo(out: Path, *, workers: int | None = None) -> int:
    """Everything, on the street; 0, or 1 where something failed. Run again, it goes on where it was.

    Raises:
        AnimaticError: something a person can mend.
    """
    console = make_console()
    times: dict[str, float] = {}
    with _timed(times, "draw the street"):
        videos = write_streets(out / "videos", workers=workers)
    job = out / "job"
    with _timed(times, "label"):
        atomic_write(out / "demo.yaml", yaml.safe_dump(_SETTINGS).encode())
        code = run_label(videos, job, JobOptions(config=out / "demo.yaml", workers=workers))
    sample = find_sample(job)
    write_picture(out / "sheet.png", contact_sheet(sample))
    truth = compare_with_truth(job)
    with _timed(times, "latents, two adapters, one sample"):
        losses, generated = train_and_generate(job, out, sample)
    rows = _result_rows(job, truth, losses, times)
    extras = ReportExtras(
        title="Animatic on the synthetic street",
        sections=[_truth_section(truth), _training_section(losses), _generated_section(sample, generated)],
        cards={"from street to sample": duration(sum(times.values()))},
    )
    page = write_report(job, out=out / "report.html", extras=extras)
    table = Table(title="the demo's results", title_justify="left", box=None, pad_edge=False, show_header=False)
    for name, value in rows:
        table.add_row(f"[bold]{name}[/]", value)
    console.print(table)
    console.print(f"report: {page.absolute()}")
    return code


def write_streets(folder: Path, *, workers: int | None = None) -> list[Path]:
    """The demo's source videos, those that are not there yet drawn side by side; their paths.

    Raises:
        StorageError: the folder cannot be written to.
        ConfigError: a worker died.
    """
    make_folder(folder)
    paths = {video_id: folder / f"{video_id}.mp4" for video_id in _STREETS}
    missing = [(video_id, path) for video_id, path in paths.items() if not path.is_file()]
    if not missing:
        return list(paths.values())
    if workers == 0:
        for video_id, path in missing:
            _write_street(video_id, path)
    else:
        context = multiprocessing.get_context("spawn")
        with minding_workers(), ProcessPoolExecutor(max_workers=workers, mp_context=context) as pool:
            list(pool.map(_write_street, *zip(*missing, strict=True)))
    return list(paths.values())


def _write_street(video_id: str, path: Path) -> None:
    temporary = path.with_suffix(".part.mp4")
    write_street_video(street_config(video_id), temporary)
    temporary.replace(path)


def compare_with_truth(job: Path) -> TruthFigures:
    """The packed clips' labels and trajectories against the streets that they show.

    Raises:
        DataError: nothing is packed.
    """
    samples = [sample for split in ("train", "val") for sample in ShardDataset(job, split)]
    if not samples:
        raise DataError(f"{job}: nothing is packed; `animatic status {job}` says why")
    streets = {sample.meta["video_id"]: Street(street_config(sample.meta["video_id"])) for sample in samples}
    cars = CarComparison()
    moves, lengths = [], []
    for sample in samples:
        meta = sample.meta
        street = streets[meta["video_id"]]
        true = street.trajectory.slice(meta["start"], meta["end"])
        moves.append(float(np.linalg.norm(sample.cam_to_world[:, :3, 3] - true.positions, axis=1).mean()))
        lengths.append(true.path_length_m)
        _compare_cars(sample, street, cars)
    return TruthFigures(
        car_recall=float(np.mean(cars.found)) if cars.found else float("nan"),
        car_precision=float(np.mean(cars.right)) if cars.right else float("nan"), cars=len(cars.found),
        point_error_px=float(np.median(np.concatenate(cars.errors_px))) if cars.errors_px else float("nan"),
        position_error_m=float(np.mean(moves)), path_m=float(np.mean(lengths)),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class CarComparison:
    """Labelled cars beside true ones, frame by frame, one label for one car."""

    found: list[bool] = field(default_factory=list)
    """Of each true car that is asked for."""
    right: list[bool] = field(default_factory=list)
    """Of each labelled car, whether it is a true one; what is no car, but too low or too hidden to be asked for, is
    left out."""
    errors_px: list[np.ndarray] = field(default_factory=list)
    """(n,) distances of the points of each found car that are visible and labelled."""

    def add(self, labels: Sequence[Keypoints], truth: Sequence[StreetObject], *, frame: int) -> None:
        """One frame's labels and objects, in the same pixels; what is no car is left out."""
        (matched,) = match_frames(labels, [truth], first_frame=frame, categories=("car",))
        paired = sum(label is not None for _, label in matched.pairs)
        self.right.extend([True] * paired + [False] * len(matched.phantoms))
        for thing, label in matched.judged:
            self.found.append(label is not None)
            if label is not None and label.schema == thing.schema:
                shown = thing.visible & label.present
                self.errors_px.append(np.linalg.norm(label.points[shown, :2] - thing.points_xy[shown], axis=1))


def _compare_cars(sample: Sample, street: Street, cars: CarComparison) -> None:
    """Cars of every 24th frame of a clip; the street has the working picture's size, so pixels are the same."""
    labels = sample.keypoints()
    start = sample.meta["start"]
    for frame in range(0, len(sample.cam_to_world), _LOOK_EVERY):
        here = [label for label in labels if label.frame == frame]
        cars.add(here, street.render(start + frame).objects, frame=frame)


def train_and_generate(job: Path, out: Path, sample: Sample) -> tuple[dict[str, list[float]], Any]:
    """Latents, both adapters for some tens of steps, and one sample of both stages; losses by stage, and files."""
    import torch

    from pipelines.train import GenerateOptions, run_cache, run_generate, run_train
    from training.adapter_notes import adapter_file

    # One thread: the tiny network gains nothing from more, and loses much where cores are shared.
    torch.set_num_threads(1)
    run_cache(job, backbone=BACKBONE)
    losses: dict[str, list[float]] = {}
    adapters: dict[str, Path] = {}
    for stage in ("motion", "appearance"):
        folder = out / "adapters" / stage
        summary = run_train(
            stage, data=job, config="tiny", out=folder, overrides={"optimiser": {"steps": TRAIN_STEPS}},
            on_step=lambda step, loss: None,
        )  # fmt: skip
        adapters[stage] = getattr(summary, "adapter", adapter_file(folder))
        losses[stage] = _logged_losses(folder / "metrics.jsonl")
    files = run_generate(
        out=out / "generated", motion=adapters["motion"], appearance=adapters["appearance"], data=job,
        clip=sample.key, options=GenerateOptions(steps=8),
    )  # fmt: skip
    return losses, files[0]


def _logged_losses(path: Path) -> list[float]:
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [float(row["loss"]) for row in rows if "loss" in row]


def _result_rows(
    job: Path, truth: TruthFigures, losses: dict[str, list[float]], times: dict[str, float]
) -> list[tuple[str, str]]:
    summary = summarize(job)
    record = clip_record(find_sample(job))
    packed = ", ".join(f"{count} {split}" for split, count in summary.packed.items())
    rows = [
        ("clips", f"{summary.kept} of {summary.clips} kept, {packed} packed"),
        ("a caption", record["caption"]),
        ("cars found", f"{truth.car_recall:.0%} of {truth.cars}, {truth.car_precision:.0%} of the labels right"),
        ("car points", f"{truth.point_error_px:.1f} px off (median)"),
        ("camera", f"{truth.position_error_m:.2f} m off on paths of {truth.path_m:.0f} m (mean, not aligned)"),
    ]
    rows += [
        (f"{stage} loss", f"{np.mean(values[:5]):.3f} to {np.mean(values[-5:]):.3f} in {len(values)} steps")
        for stage, values in losses.items()
        if values
    ]
    return rows + [(name, duration(seconds)) for name, seconds in times.items()]


def _truth_section(truth: TruthFigures) -> Section:
    rows = [
        (
            "cars found",
            f"{truth.car_recall:.1%}",
            f"of {truth.cars} at least 32 px high and 30 % visible; one label for each, IoU 0.3",
        ),
        (
            "labels that are cars",
            f"{truth.car_precision:.1%}",
            "a true car, IoU 0.3; what is none counts as wrong if 32 px high and not on a car too low or hidden to be "
            "looked for",
        ),
        ("car points", f"{truth.point_error_px:.2f} px", "median distance, visible points of found cars"),
        (
            "camera",
            f"{truth.position_error_m:.2f} m",
            f"mean displacement, not aligned; mean path {truth.path_m:.1f} m",
        ),
    ]
    return Section(
        title="Labels against the truth", text="The street knows where everything is; every 24th frame is compared.",
        tables=[PageTable(columns=("what", "figure", "how"), rows=rows, numbers=(1,))],
    )  # fmt: skip


def _training_section(losses: dict[str, list[float]]) -> Section:
    text = (
        "Random tiny weights, some tens of steps: the thread from videos to adapters is real, the pictures are not "
        "meant to be good."
    )
    picture = Picture(data=png_data(draw_losses(losses)), caption="Loss of both stages on the tiny backbone")
    return Section(title="Two adapters", text=text, pictures=[picture])


def _generated_section(sample: Sample, files: Any) -> Section:
    streams: list[Sequence[np.ndarray]] = [list(sample.iterate_frames("rgb.mp4"))]
    streams += [list(read_frames(path)) for path in (files.control, files.rgb) if path is not None]
    count = min(len(frames) for frames in streams)
    video = mp4_data([tiled([frames[index] for frames in streams]) for index in range(count)], crf=36)
    pictures = [
        Picture(kind="video", data=video, caption="The clip itself, the generated skeletons, the generated RGB"),
        Picture(data=png_data(contact_sheet(sample)), caption=f"{sample.key}, whose first frame it starts from"),
    ]
    return Section(title="One sample, two stages", pictures=pictures)


@contextmanager
def _timed(times: dict[str, float], name: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    times[name] = time.perf_counter() - started

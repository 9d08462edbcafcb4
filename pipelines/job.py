"""A job: its folder, its settings and its source videos, as ``job.yaml`` holds them."""

import csv
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from dataset.receipts import Receipt, atomic_write, read_receipts
from labeling.errors import ConfigError
from labeling.timeline import LONGEST_VIDEO_ID, check_video_id
from pipelines.config import Config, parse_config, read_yaml
from pipelines.stage import WorkItem, item_state, load_stage

VIDEO_SUFFIXES = frozenset({".mp4", ".mkv", ".mov", ".avi", ".webm", ".m4v", ".ts", ".mts", ".mpg", ".mpeg", ".flv"})
_LIST_SUFFIXES = frozenset({".txt", ".lst", ".list", ".tsv"})


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportedTrajectory:
    """A video's trajectory from elsewhere, as copied into the job."""

    file: str
    """Relative to the job's folder."""
    sha256: str
    offset_s: float = 0.0
    """The file's time at the video's first frame."""
    fps: float | None = None
    """Rows a second, of a file without times; None: a row for each frame of the source."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One source video of a job."""

    video_id: str
    path: Path
    leave_out_s: tuple[float, float] = (0.0, 0.0)
    """Seconds at its start and at its end that no clip may touch (intro, credits)."""
    trajectory: ImportedTrajectory | None = None
    """Instead of an estimated one."""


class Job:
    """A job's folder with what ``job.yaml`` says; plans and receipts are read once until ``refresh``."""

    def __init__(
        self, root: Path, config: Config, sources: Mapping[str, Source], *, models_dir: Path | None = None
    ) -> None:
        self.root, self.config, self.models_dir = root, config, models_dir
        self.sources: dict[str, Source] = dict(sorted(sources.items()))
        self.selection_mode: str = "auto"
        self._plans: dict[str, list[WorkItem]] = {}
        self._receipts: dict[str, dict[str, Receipt]] = {}
        self._settled: dict[str, dict[str, Receipt]] = {}

    def refresh(self) -> None:
        """Forget plans and receipts: a stage has run, here or elsewhere."""
        self._plans.clear()
        self._receipts.clear()
        self._settled.clear()

    def plan(self, stage: str) -> list[WorkItem]:
        """The items of a stage.

        Raises:
            NotReadyError: the stage waits for all of an earlier one.
        """
        if stage not in self._plans:
            self._plans[stage] = load_stage(stage).plan(self)
        return self._plans[stage]

    def receipts(self, stage: str) -> dict[str, Receipt]:
        """The receipt that holds for each item of a stage."""
        if stage not in self._receipts:
            self._receipts[stage] = read_receipts(self.root, stage)
        return self._receipts[stage]

    def settled(self, stage: str) -> dict[str, Receipt]:
        """Up-to-date receipts of a stage's planned items, whatever their state; failures to be retried included."""
        if stage not in self._settled:
            known = self.receipts(stage)
            states = {item.name: item_state(item, known.get(item.name), self.root) for item in self.plan(stage)}
            self._settled[stage] = {
                name: known[name] for name, state in states.items() if state in ("current", "retry")
            }
        return self._settled[stage]

    def done(self, stage: str) -> dict[str, Receipt]:
        """Up-to-date receipts of a stage's items that are done."""
        return {name: receipt for name, receipt in self.settled(stage).items() if receipt.state == "done"}

    def pending(self, stage: str) -> list[WorkItem]:
        """Items of a stage that have no up-to-date receipt at all, in any part."""
        settled = self.settled(stage)
        return [item for item in self.plan(stage) if item.name not in settled]

    def save(self) -> None:
        """Write ``job.yaml``, if it would change.

        Raises:
            StorageError: the folder cannot be written to.
        """
        values = {
            "config": self.config.model_dump(mode="json", exclude_defaults=True),
            "videos": {name: _source_values(source) for name, source in self.sources.items()},
        }
        if self.models_dir:
            values["models"] = str(self.models_dir)
        data = yaml.safe_dump(values, sort_keys=True, allow_unicode=True, width=120).encode()
        path = self.root / "job.yaml"
        if not (path.is_file() and path.read_bytes() == data):
            atomic_write(path, data)


def open_job(root: Path) -> Job:
    """The job in a folder.

    Raises:
        ConfigError: there is none, or its ``job.yaml`` cannot be used.
    """
    path = root / "job.yaml"
    if not path.is_file():
        raise ConfigError(f"{root}: holds no job.yaml; make a job with `animatic label VIDEO... --out {root}`")
    values = read_yaml(path)
    videos, config, models = values.get("videos") or {}, values.get("config") or {}, values.get("models")
    for key, part in (("videos", videos), ("config", config)):
        if not isinstance(part, dict):
            raise ConfigError(f"{path}: {key} needs a mapping, holds {part!r}; mend it")
    if not isinstance(models, str | None):
        raise ConfigError(f"{path}: models needs a folder's path, holds {models!r}; mend it")
    sources = {name: _read_source(path, name, entry) for name, entry in videos.items()}
    return Job(root, parse_config(config, str(path)), sources, models_dir=Path(models) if models else None)


def _read_source(job_file: Path, video_id: Any, entry: Any) -> Source:
    try:
        check_video_id(video_id)
        leave_out_s = _pair(entry.get("leave_out_s", (0, 0)))
        if not _are_lengths(leave_out_s):
            raise ValueError(f"leave_out_s holds {leave_out_s}, no two lengths of time")
        trajectory = ImportedTrajectory(**entry["trajectory"]) if "trajectory" in entry else None
        return Source(video_id=video_id, path=Path(entry["path"]), leave_out_s=leave_out_s, trajectory=trajectory)
    except Exception as error:
        raise ConfigError(
            f"{job_file}: videos: {video_id!r} cannot be {entry!r} ({error}); give it a path and, if wanted, "
            "leave_out_s: [START, END]"
        ) from error


def open_or_create(
    root: Path,
    *,
    videos: Sequence[Source] = (),
    config: Config | None = None,
    models_dir: Path | None = None,
    leave_out: Path | None = None,
) -> Job:
    """The job in ``root`` with ``videos`` added and, where given, other settings and models. Nothing is written yet.

    Of a video that the job has, all but its path stays as the job has it, unless the table ``leave_out`` names it.

    Raises:
        ConfigError: a video has the id of another one, no job and no videos, or a table that cannot be used.
    """
    known = open_job(root) if (root / "job.yaml").is_file() else None
    sources = dict(known.sources) if known else {}
    for source in videos:
        old = sources.get(source.video_id)
        if old is not None and absolute(old.path) != absolute(source.path) and old.path.exists():
            raise ConfigError(_same_id(source.video_id, old.path, source.path))
        sources[source.video_id] = replace(old, path=source.path) if old else source
    if not sources:
        raise ConfigError(f"{root}: holds no job and no videos were given; name some VIDEO files or folders")
    if leave_out is not None:
        sources = with_leave_out(sources, leave_out)
    models_dir = absolute(models_dir) if models_dir else (known.models_dir if known else None)
    return Job(root, config or (known.config if known else Config()), sources, models_dir=models_dir)


def find_videos(arguments: Sequence[Path], *, out: Path | None = None) -> list[Source]:
    """The source videos that a person named: files, folders (searched to their depths), text files of paths.

    A line of a text file is a path, relative to that file, with an id before it if wanted: ``id<TAB>path``. What a job
    made is no source: below a folder, ``out`` and every folder that holds a ``job.yaml`` are left out.

    Raises:
        ConfigError: nothing there, an id that cannot be used, two videos with one id, or none of them exists.
    """
    found = [entry for argument in arguments for entry in _expand(argument, out)]
    sources: dict[str, Source] = {}
    for video_id, path in found:
        check_id(video_id, path)
        old = sources.get(video_id)
        if old is not None and old.path != path:
            raise ConfigError(_same_id(video_id, old.path, path))
        sources[video_id] = Source(video_id=video_id, path=path)
    if sources and not any(source.path.exists() for source in sources.values()):
        missing = next(iter(sources.values())).path
        raise ConfigError(f"{missing}: no such file; check the path")
    return list(sources.values())


def with_leave_out(sources: Mapping[str, Source], table: Path) -> dict[str, Source]:
    """Sources with what a table (see ``read_leave_out``) leaves out of those that it names; the others as they are.

    Raises:
        ConfigError: the table cannot be used, or names a video that is none of them.
    """
    spans = read_leave_out(table)
    unknown = sorted(set(spans) - set(sources))
    if unknown:
        raise ConfigError(f"{table}: names {unknown[0]!r}, which is none of the videos; use ids, as {_some(sources)}")
    named = {video_id: replace(sources[video_id], leave_out_s=span) for video_id, span in spans.items()}
    return {**sources, **named}


def absolute(path: Path) -> Path:
    """A path from the root, without ``..``, so that a file has one name by every route; links keep theirs."""
    return Path(os.path.normpath(path.absolute()))


def check_id(video_id: str, path: Path) -> None:
    """Raise ``ConfigError`` unless a video's id can be part of a clip's key."""
    try:
        check_video_id(video_id)
    except Exception as error:
        raise ConfigError(
            f"{path}: {video_id!r} is no video id (at most {LONGEST_VIDEO_ID} letters, digits, - and _); rename the "
            "file, or give a text file of lines `id<TAB>path` in its place"
        ) from error


def read_leave_out(path: Path) -> dict[str, tuple[float, float]]:
    """Seconds to leave out at each video's start and end: a CSV table with the columns ``video_id, start_s, end_s``.

    Raises:
        ConfigError: it cannot be read, lacks a column, names a video twice, or holds something that is no length.
    """
    spans: dict[str, tuple[float, float]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            for number, row in enumerate(csv.DictReader(stream), start=2):
                span = _pair((row["start_s"] or 0, row["end_s"] or 0))
                if not _are_lengths(span) or row["video_id"] in spans:
                    raise ValueError(f"line {number} repeats a video or is no length of time")
                spans[row["video_id"]] = span
    except KeyError as error:
        raise ConfigError(f"{path}: has no column {error}; give video_id,start_s,end_s") from error
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read as video_id,start_s,end_s ({error}); mend the table") from error
    return spans


def _pair(values: Sequence[Any]) -> tuple[float, float]:
    start, end = values
    return float(start), float(end)


def _are_lengths(values: Sequence[float]) -> bool:
    return all(0 <= value < math.inf for value in values)


def _expand(argument: Path, out: Path | None) -> list[tuple[str, Path]]:
    if argument.is_dir():
        if _is_job(argument, out):
            raise ConfigError(
                f"{argument}: is a job's own folder; give the folder of the videos, and --out another one (a job that "
                "is there goes on without any VIDEO)"
            )
        files = sorted(_files_below(argument, out))
        if not files:
            raise ConfigError(f"{argument}: holds no videos ({', '.join(sorted(VIDEO_SUFFIXES))}); check the path")
        return [(path.stem, absolute(path)) for path in files]
    if argument.suffix.lower() in _LIST_SUFFIXES and argument.is_file():
        return _read_list(argument)
    return [(argument.stem, absolute(argument))]


def _files_below(folder: Path, out: Path | None) -> Iterator[Path]:
    """Every video file below a folder, but those of jobs."""
    for place, folders, names in os.walk(folder):
        here = Path(place)
        folders[:] = [name for name in folders if not _is_job(here / name, out)]
        files = (here / name for name in names)
        yield from (path for path in files if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file())


def _is_job(folder: Path, out: Path | None) -> bool:
    """Whether a folder is a job's, or about to be."""
    return (folder / "job.yaml").is_file() or (out is not None and folder.resolve() == out.resolve())


def _read_list(path: Path) -> list[tuple[str, Path]]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as a list of videos ({error}); give a path on each line") from error
    entries = []
    for line in lines:
        video_id, tab, name = line.strip().rpartition("\t")
        if not name.strip() or line.lstrip().startswith("#"):
            continue
        video = absolute(path.parent / name.strip())
        entries.append((video_id.strip() if tab else video.stem, video))
    if not entries:
        raise ConfigError(f"{path}: lists no videos; give a path on each line")
    return entries


def _same_id(video_id: str, first: Path, second: Path) -> str:
    return (
        f"two videos would be called {video_id!r}: {first} and {second}; rename one, or give a text file of lines "
        "`id<TAB>path` in their place"
    )


def _some(sources: Mapping[str, Source]) -> str:
    return ", ".join(repr(name) for name in list(sources)[:3])


def _source_values(source: Source) -> dict[str, Any]:
    values: dict[str, Any] = {"path": str(source.path)}
    if any(source.leave_out_s):
        values["leave_out_s"] = list(source.leave_out_s)
    if source.trajectory is not None:
        values["trajectory"] = {name: value for name, value in asdict(source.trajectory).items() if value is not None}
    return values

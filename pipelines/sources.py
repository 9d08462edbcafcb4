"""The source videos of a job: how a person names them, and how ``job.yaml`` keeps them."""

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from dataset.layout import JOB_FILE
from labeling.errors import AnimaticError, ConfigError
from labeling.timeline import LONGEST_VIDEO_ID, check_video_id
from pipelines.given_tables import read_leave_out, two_lengths

VIDEO_SUFFIXES = frozenset({".mp4", ".mkv", ".mov", ".avi", ".webm", ".m4v", ".ts", ".mts", ".mpg", ".mpeg", ".flv"})
_OTHER_FOLDER = "give the folder of the videos, and --out another one (a job that is there goes on without any VIDEO)"
_MOST_NAMED = 8
_SAMPLES, _SAMPLE_BYTES = 16, 1 << 20
"""Places of a file that are compared, of which neighbours overlap in a small file."""
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


def read_source(job_file: Path, video_id: Any, entry: Any) -> Source:
    """A source as ``job.yaml`` keeps it.

    Raises:
        ConfigError: an id, a path or a length that cannot be.
    """
    try:
        check_video_id(video_id)
        leave_out_s = two_lengths(*entry.get("leave_out_s", (0, 0)))
        trajectory = ImportedTrajectory(**entry["trajectory"]) if "trajectory" in entry else None
        return Source(video_id=video_id, path=Path(entry["path"]), leave_out_s=leave_out_s, trajectory=trajectory)
    except Exception as error:
        raise ConfigError(
            f"{job_file}: videos: {video_id!r} cannot be {entry!r} ({error}); give it a path and, if wanted, "
            "leave_out_s: [START, END]"
        ) from error


def source_values(source: Source) -> dict[str, Any]:
    """As ``job.yaml`` keeps a source."""
    values: dict[str, Any] = {"path": str(source.path)}
    if any(source.leave_out_s):
        values["leave_out_s"] = list(source.leave_out_s)
    if source.trajectory is not None:
        values["trajectory"] = {name: value for name, value in asdict(source.trajectory).items() if value is not None}
    return values


def find_videos(arguments: Sequence[Path], *, out: Path | None = None) -> list[Source]:
    """The source videos that a person named: files, folders (searched to their depths), text files of paths.

    A line of a text file is a path, relative to that file, with an id before it if wanted: ``id<TAB>path``. What a job
    made is no source: below a folder, ``out`` and every folder that holds a ``job.yaml`` are left out.

    Raises:
        ConfigError: nothing there, ids that cannot be used, two videos with one id, a video that lies in ``out``, or
            none of them exists.
    """
    found = [entry for argument in arguments for entry in _expand(argument, out)]
    _check_ids(found)
    sources: dict[str, Source] = {}
    for video_id, path, place in found:
        if out is not None and out.resolve() in (path.parent.resolve(), *path.parent.resolve().parents):
            raise ConfigError(f"{place}: lies in the job's own folder {out}; {_OTHER_FOLDER}")
        old = sources.get(video_id)
        if old is not None and old.path != path:
            raise ConfigError(same_id(video_id, old.path, path))
        sources[video_id] = Source(video_id=video_id, path=path)
    if sources and not any(source.path.exists() for source in sources.values()):
        raise ConfigError(f"{found[0].place}: no such file; check the path")
    return list(sources.values())


def with_leave_out(sources: Mapping[str, Source], table: Path) -> dict[str, Source]:
    """Sources with what a table (for ``read_leave_out``) leaves out of those that it names; the others as they are.

    Raises:
        ConfigError: the table cannot be used, or names a video that is none of them.
    """
    spans = read_leave_out(table)
    unknown = sorted(set(spans) - set(sources))
    if unknown:
        raise ConfigError(f"{table}: names {unknown[0]!r}, which is none of the videos; use ids, as {_some(sources)}")
    named = {video_id: replace(sources[video_id], leave_out_s=span) for video_id, span in spans.items()}
    return {**sources, **named}


def likely_twins(sources: Sequence[Source]) -> dict[str, str]:
    """By video id, the first of the videos that seem to have the same bytes; none for those that are the first.

    The job compares whole files. Here files of one size are, by what lies at some places of them: all of a small one.
    """
    by_size: dict[int, list[Source]] = {}
    for source in sorted(sources, key=lambda source: source.video_id):
        by_size.setdefault(source.path.stat().st_size, []).append(source)
    twins: dict[str, str] = {}
    for size, alike in by_size.items():
        first: dict[str, str] = {}
        for source in alike if len(alike) > 1 else ():
            holder = first.setdefault(_sampled_sha256(source.path, size), source.video_id)
            if holder != source.video_id:
                twins[source.video_id] = holder
    return twins


def _sampled_sha256(path: Path, size: int) -> str:
    seen = hashlib.sha256()
    with path.open("rb") as stream:
        for number in range(_SAMPLES):
            stream.seek(max(0, size - _SAMPLE_BYTES) * number // (_SAMPLES - 1))
            seen.update(stream.read(_SAMPLE_BYTES))
    return seen.hexdigest()


def same_id(video_id: str, first: Path, second: Path) -> str:
    """What is said of two files with one id."""
    return (
        f"two videos would be called {video_id!r}: {first} and {second}; rename one, or give a text file of lines "
        "`id<TAB>path` in their place"
    )


def absolute(path: Path) -> Path:
    """A path from the root, without ``..``, so that a file has one name by every route; links keep theirs."""
    return Path(os.path.normpath(path.absolute()))


class _Named(NamedTuple):
    """A video as a person named it."""

    video_id: str
    path: Path
    place: str
    """What to call it in an error: its path, after the list and the line that name it."""


def _check_ids(found: Sequence[_Named]) -> None:
    """Raise ``ConfigError``, once for all, unless every video's id can be part of a clip's key."""
    wrong = [f"{named.place}: {named.video_id!r}" for named in found if not _is_id(named.video_id)]
    if wrong:
        rule = f"is no video id (at most {LONGEST_VIDEO_ID} letters, digits, - and _)"
        others = ", ".join(wrong[1:_MOST_NAMED]) + (
            f" and {len(wrong) - _MOST_NAMED} more" * (len(wrong) > _MOST_NAMED)
        )
        raise ConfigError(
            f"{wrong[0]} {rule}{f', nor are {others}' if others else ''}; rename the file{'s' * (len(wrong) > 1)}, or "
            "give a text file of lines `id<TAB>path` in their place"
        )


def _is_id(video_id: str) -> bool:
    try:
        check_video_id(video_id)
    except AnimaticError:
        return False
    return True


def _expand(argument: Path, out: Path | None) -> list[_Named]:
    if argument.is_dir():
        if _is_job(argument, out):
            raise ConfigError(f"{argument}: is a job's own folder; {_OTHER_FOLDER}")
        files = sorted(_files_below(argument, out))
        if not files:
            raise ConfigError(f"{argument}: holds no videos ({', '.join(sorted(VIDEO_SUFFIXES))}); check the path")
        return [_Named(path.stem, absolute(path), str(path)) for path in files]
    if argument.suffix.lower() in _LIST_SUFFIXES and argument.is_file():
        return _read_list(argument)
    return [_Named(argument.stem, absolute(argument), str(argument))]


def _files_below(folder: Path, out: Path | None) -> Iterator[Path]:
    """Every video file below a folder, but those of jobs; a link to nothing is one, so that it is told of."""
    for place, folders, names in os.walk(folder):
        here = Path(place)
        folders[:] = [name for name in folders if not _is_job(here / name, out)]
        files = (here / name for name in names)
        yield from (
            path for path in files if path.suffix.lower() in VIDEO_SUFFIXES and (path.is_file() or path.is_symlink())
        )


def _is_job(folder: Path, out: Path | None) -> bool:
    """Whether a folder is a job's, or about to be."""
    return (folder / JOB_FILE).is_file() or (out is not None and folder.resolve() == out.resolve())


def _read_list(path: Path) -> list[_Named]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as a list of videos ({error}); give a path on each line") from error
    entries = []
    for number, line in enumerate(lines, start=1):
        video_id, tab, name = line.strip().rpartition("\t")
        if not name.strip() or line.lstrip().startswith("#"):
            continue
        video = absolute(path.parent / name.strip())
        place = f"{path}: line {number}: {video}"
        if "\0" in name or video.is_dir():
            raise ConfigError(f"{place}: is no file's path; give one on each line, with `id<TAB>` before it if wanted")
        entries.append(_Named(video_id.strip() if tab else video.stem, video, place))
    if not entries:
        raise ConfigError(f"{path}: lists no videos; give a path on each line")
    return entries


def _some(sources: Mapping[str, Source]) -> str:
    return ", ".join(repr(name) for name in list(sources)[:3])

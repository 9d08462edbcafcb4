"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

STOPPED = 130
"""Exit code of a command that was interrupted and goes on when it is run again."""
LABEL, STAGES, LOOK, TRAIN, MEASURE = "Label videos", "Single stages", "Look", "Train and sample", "Measure"

Videos = Annotated[list[Path], typer.Argument(help="Video files, folders of them, or text files of paths.")]
MoreVideos = Annotated[
    list[Path] | None,
    typer.Argument(help="Video files, folders of them, or text files of paths; a job that is there keeps its own."),
]
Out = Annotated[Path, typer.Option("--out", "-o", help="The job's folder.")]
JobFolder = Annotated[Path, typer.Argument(help="The job's folder.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="Settings in YAML.")]
Effort = Annotated[str | None, typer.Option("--effort", help="fast, balanced or exact.")]
KeepShare = Annotated[float | None, typer.Option(help="Share of the clips to keep, by objects; 1 keeps every clip.")]
Models = Annotated[Path | None, typer.Option("--models", help="Folder of ONNX weights.")]
Extractors = Annotated[
    str | None, typer.Option(help="Model cards by name, with commas; 'street' for the shipped ones.")
]
Workers = Annotated[int | None, typer.Option(min=0, help="Processes; by default one per core.")]
PartOf = Annotated[str | None, typer.Option("--part", help="i/n: this host's share of the videos.")]
LeaveOut = Annotated[Path | None, typer.Option(help="CSV of video_id,start_s,end_s: seconds to leave out at each end.")]
Cameras = Annotated[
    Path | None, typer.Option(help="CSV of video_id and what is known of its camera: fx,fy,cx,cy,height_m,pitch_deg.")
]
Wait = Annotated[float, typer.Option(help="Minutes to wait for other parts that make no progress.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def listed(text: str) -> tuple[str, ...]:
    """The names of a list with commas, without the spaces and the empty ones that lists typed by hand have."""
    return tuple(name.strip() for name in text.split(",") if name.strip())

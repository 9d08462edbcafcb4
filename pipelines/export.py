"""``animatic export released``: loose files and the JSONL manifest that the released trainer reads."""

import json
from pathlib import Path

from dataset.loader import Sample, ShardDataset
from dataset.receipts import atomic_write
from labeling.errors import ConfigError
from pipelines.black_skeletons import print_black_skeletons
from pipelines.console import counted, make_console
from pipelines.sources import absolute


def export_released(job: Path, out: Path, *, split: str = "train") -> int:
    """Write ``rgb/<key>.mp4``, ``pose/<key>.mp4`` and ``<split>.jsonl`` (``id, caption, rgb_path, pose_path``).

    ``pose_path`` is the released name of the skeleton video. Files that are there with the right bytes stay.

    Raises:
        ConfigError: a split that is not known, or has no clips, or ``out`` is the job's own folder.
        DataError: the job is not packed, or was packed without views.
        StorageError: no space left, or ``out`` cannot be written to.
    """
    if split not in ("train", "val"):
        raise ConfigError(f"--split {split!r} is not known; choose train or val")
    dataset = ShardDataset(job, split)
    if not len(dataset):
        raise ConfigError(f"{job}: its {split} split is empty; export the other, or label more source videos")
    refuse_job_folder(job, out)
    out = absolute(out)
    lines = [json.dumps(_export_clip(sample, out)) for sample in dataset]
    manifest = out / f"{split}.jsonl"
    atomic_write(manifest, ("\n".join(lines) + "\n").encode())
    print_black_skeletons(job, make_console())
    make_console().print(f"{counted(len(lines), 'clip')} in {manifest}")
    other = "val" if split == "train" else "train"
    if left := len(ShardDataset(job, other)):
        make_console().print(f"{counted(left, 'clip')} of {other} {'is' if left == 1 else 'are'} left: --split {other}")
    return 0


def refuse_job_folder(job: Path, out: Path) -> None:
    """Raise ``ConfigError`` where an export would be strewn among a job's own files."""
    if out.resolve() == job.resolve():
        raise ConfigError(f"--out {out}: is the job's own folder; give another, such as {out / 'export'}")


def _export_clip(sample: Sample, out: Path) -> dict[str, str]:
    paths = {"rgb_path": ("rgb", "rgb.mp4"), "pose_path": ("pose", "skeleton.mp4")}
    record = {"id": sample.key, "caption": sample.caption}
    for name, (folder, suffix) in paths.items():
        target = out / folder / f"{sample.key}.mp4"
        data = sample.member(suffix)
        if not target.is_file() or target.read_bytes() != data:
            atomic_write(target, data)
        record[name] = str(target)
    return record

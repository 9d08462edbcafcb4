"""A job: its folder, its settings and its source videos, as ``job.yaml`` holds them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import yaml

from dataset.layout import JOB_FILE
from dataset.receipts import Receipt, atomic_write, read_receipts
from labeling.errors import ConfigError
from labeling.settings_files import read_yaml
from pipelines.config import Config, parse_config
from pipelines.sources import Source, absolute, read_source, same_id, source_values, with_leave_out
from pipelines.stage import WorkItem, item_state, load_stage


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
            "videos": {name: source_values(source) for name, source in self.sources.items()},
        }
        if self.models_dir:
            values["models"] = str(self.models_dir)
        data = yaml.safe_dump(values, sort_keys=True, allow_unicode=True, width=120).encode()
        path = self.root / JOB_FILE
        if not (path.is_file() and path.read_bytes() == data):
            atomic_write(path, data)


def open_job(root: Path) -> Job:
    """The job in a folder.

    Raises:
        ConfigError: there is none, or its ``job.yaml`` cannot be used.
    """
    path = root / JOB_FILE
    if not path.is_file():
        raise ConfigError(f"{root}: holds no job.yaml; make a job with `animatic label VIDEO... --out {root}`")
    values = read_yaml(path)
    videos, config, models = values.get("videos") or {}, values.get("config") or {}, values.get("models")
    for key, part in (("videos", videos), ("config", config)):
        if not isinstance(part, dict):
            raise ConfigError(f"{path}: {key} needs a mapping, holds {part!r}; mend it")
    if not isinstance(models, str | None):
        raise ConfigError(f"{path}: models needs a folder's path, holds {models!r}; mend it")
    sources = {name: read_source(path, name, entry) for name, entry in videos.items()}
    return Job(root, parse_config(config, str(path)), sources, models_dir=Path(models) if models else None)


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
    known = open_job(root) if (root / JOB_FILE).is_file() else None
    sources = dict(known.sources) if known else {}
    for source in videos:
        old = sources.get(source.video_id)
        if old is not None and absolute(old.path) != absolute(source.path) and old.path.exists():
            raise ConfigError(same_id(source.video_id, old.path, source.path))
        sources[source.video_id] = replace(old, path=source.path) if old else source
    if not sources:
        raise ConfigError(f"{root}: holds no job and no videos were given; name some VIDEO files or folders")
    if leave_out is not None:
        sources = with_leave_out(sources, leave_out)
    models_dir = absolute(models_dir) if models_dir else (known.models_dir if known else None)
    return Job(root, config or (known.config if known else Config()), sources, models_dir=models_dir)

"""What a training leaves to others: two in one folder, kills between two writes, records that were damaged."""

import hashlib
import json
import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from training_fixtures import cached_job, in_children, one_thread, tiny_config, tiny_job  # noqa: F401

from labeling.errors import AnimaticError, ConfigError, DataError, ModelError, StorageError
from training import checkpoints
from training.adapter_notes import read_about, read_progress
from training.adapters import read_adapter
from training.checkpoints import list_checkpoints, newest_checkpoint, save_checkpoint
from training.config import TrainConfig
from training.latent_store import LatentStore
from training.run_log import METRICS, read_metrics
from training.run_state import ADAPTER, FILES, read_state
from training.trainer import TrainSummary, train


def refusal(call: Callable[[], Any]) -> str:
    with pytest.raises(ConfigError) as error:
        call()
    return str(error.value)


def test_two_trainings_do_not_share_a_folder(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    """The second is refused at once; the first ends as if it had been alone."""
    config, told = tiny_config("motion", checkpoint={"every_steps": 1}), []

    def second(_: int) -> str:
        return refusal(lambda: train(config, data=tiny_job, out=tmp_path, quiet=True))

    def on_step(step: int, _: float) -> None:
        if step == 2:
            told.extend(in_children(1, second))

    train(config, data=tiny_job, out=tmp_path, quiet=True, on_step=on_step)
    assert told == [f"{tmp_path} is in use: {told[0].split(': ')[1].split(' trains')[0]} trains there; let it end, or "
                    "give another --out"]  # fmt: skip
    assert f"process {os.getpid()} on " in told[0]
    assert [line["step"] for line in read_metrics(tmp_path)] == [1, 2, 3, 4]
    assert newest_checkpoint(tmp_path / "checkpoints") == tmp_path / "checkpoints" / "step_00000004"
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_the_mark_of_a_killed_training_keeps_nobody_out(tmp_path: Path) -> None:
    from training.claims import Claim

    def killed(_: int) -> None:
        Claim(tmp_path)
        os.kill(os.getpid(), 9)

    assert in_children(1, killed) == [None]
    assert list(tmp_path.iterdir()), "it left its mark"
    Claim(tmp_path).release()
    assert not list(tmp_path.iterdir())


def test_a_folder_made_for_a_claim_goes_with_it(tmp_path: Path) -> None:
    from training.claims import Claim

    out = tmp_path / "a" / "b"
    for wrote in (False, True):
        claim = Claim(out)
        if wrote:
            (out / "metrics.jsonl").write_text("")
        claim.release()
        assert out.exists() == (tmp_path / "a").exists() == wrote
    assert [path.name for path in out.iterdir()] == ["metrics.jsonl"]


def test_saving_sweeps_what_the_dead_left_and_nothing_of_the_living(tmp_path: Path) -> None:
    from dataset.receipts import host_name

    (dead,) = in_children(1, lambda _: os.getpid())
    names = {
        "dead": f".step_00000007.{host_name()}-{dead}", "living": f".step_00000007.{host_name()}-{os.getppid()}",
        "elsewhere": f".step_00000007.other-host-{dead}", "older version": ".step_00000007.123",
    }  # fmt: skip
    for name in names.values():
        (tmp_path / name).mkdir()
    save_checkpoint(tmp_path, 8, {"a": b"x"}, keep=1)
    left = {kind for kind, name in names.items() if (tmp_path / name).exists()}
    assert left == {"living", "elsewhere"}


def test_a_staging_folder_that_vanishes_is_a_storage_error(tmp_path: Path, monkeypatch) -> None:
    digest = checkpoints._digest
    monkeypatch.setattr(checkpoints, "_digest", lambda path: (digest(path), shutil.rmtree(path.parent))[0])
    with pytest.raises(StorageError, match="taken away while a checkpoint was written"):
        save_checkpoint(tmp_path, 1, {"a": b"x"}, keep=1)
    assert list_checkpoints(tmp_path) == []


@pytest.fixture(scope="module")
def finished(tiny_job: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A run of two steps with a checkpoint of each; read it, do not write to it."""
    out = tmp_path_factory.mktemp("finished") / "run"
    train(two_steps(), data=tiny_job, out=out, quiet=True)
    return out


def two_steps() -> TrainConfig:
    return tiny_config("motion", optimiser={"steps": 2}, checkpoint={"every_steps": 1, "keep": 2})


def resumed(job: Path, out: Path) -> int:
    """The step that a run went on from."""
    summary = train(two_steps(), data=job, out=out, quiet=True)
    assert isinstance(summary, TrainSummary)
    return summary.started_at


@pytest.mark.parametrize(
    "damage", [b"garbage\n", b'{"a": 1}\n', b'{"step": "x"}\n', b"\xff\xfe\n", b"[1]\n"],
    ids=["garbage", "no step", "step of text", "not UTF-8", "list"],
)  # fmt: skip
def test_damaged_lines_of_the_metrics_do_not_stop_a_resume(
    damage: bytes, tiny_job: Path, finished: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    out = shutil.copytree(finished, tmp_path / "run")
    (out / METRICS).write_bytes(damage + (out / METRICS).read_bytes())
    with pytest.warns(UserWarning, match=rf"leaving out {out / METRICS}:1, which tells no step"):
        assert resumed(tiny_job, out) == 2
    assert (out / METRICS).read_bytes() == (finished / METRICS).read_bytes()


@pytest.mark.parametrize(
    "line", [b"garbage", b"\xff\xfe", b"[1]", b'{"key": "a"}', b'{"key": ["a"], "split": "train"}'],
    ids=["garbage", "not UTF-8", "list", "lacking", "key of another kind"],
)  # fmt: skip
def test_a_damaged_record_of_latents_is_named_with_its_line(line: bytes, tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    store = shutil.copytree(tiny_job / "latents" / "tiny", tmp_path / "tiny")
    (log,) = store.glob("clips-*.jsonl")
    first, _, rest = log.read_bytes().partition(b"\n")
    log.write_bytes(first + b"\n" + line + b"\n" + rest)
    with pytest.raises(DataError, match=rf"{log}:2: is no record .*take the line away and run `animatic cache`"):
        LatentStore(store)
    log.write_bytes(first + b"\n" + rest + line)
    assert LatentStore(store).keys("train") == LatentStore(tiny_job / "latents" / "tiny").keys("train"), "a torn end"


@pytest.mark.parametrize(
    "change", [{"parts": []}, {"frames": "x"}, {"fps": None}, {"backbone": 3}, None], ids=str
)  # fmt: skip
def test_a_manifest_of_latents_with_values_of_another_kind_is_named(
    change: dict | None, tiny_job: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    store = shutil.copytree(tiny_job / "latents" / "tiny", tmp_path / "tiny")
    tree = json.loads((store / "cache.json").read_text())
    (store / "cache.json").write_text(json.dumps([] if change is None else tree | change))
    with pytest.raises(DataError, match="cache.json is no manifest of latents .*cache again"):
        LatentStore(store)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"animatic": "{"}, "'animatic' is no JSON object"),
        ({"animatic": "[1]"}, "'animatic' is no JSON object"),
        ({"animatic": '{"config": []}'}, "'animatic' holds no settings of a training"),
        ({"animatic": '{"config": {"optimiser": 3}}'}, "'animatic' holds no settings of a training"),
        ({"animatic": '{"stage": ["motion"]}'}, "'animatic' holds no settings of a training"),
        ({"lora_adapter_metadata": "{"}, "'lora_adapter_metadata' is no JSON object"),
        ({"lora_adapter_metadata": "[1]"}, "'lora_adapter_metadata' is no JSON object"),
        ({"lora_adapter_metadata": '{"a.lora_alpha": "x"}'}, "lora_alpha is 'x', but must be a finite number"),
        ({"lora_adapter_metadata": '{"a.lora_alpha": NaN}'}, "lora_alpha is nan, but must be a finite number"),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_damaged_metadata_of_an_adapter_is_named(
    metadata: dict[str, str], message: str, finished: Path, tmp_path: Path
) -> None:
    from safetensors.torch import load_file, save_file

    path = tmp_path / "a.safetensors"
    save_file(load_file(finished / "adapter.safetensors"), path, metadata=metadata)
    readers: list[Callable[[Path], Any]] = [read_adapter]
    if "animatic" in metadata:
        readers += [read_about, read_progress]
    for read in readers:
        with pytest.raises(ModelError, match=rf"{path}: .*{message}"):
            read(path)


def listed(checkpoint: Path, name: str, text: str) -> None:
    """Another content of a checkpoint's file, to which its manifest agrees."""
    (checkpoint / name).write_text(text)
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    manifest["files"][name] = {"size": len(text), "sha256": hashlib.sha256(text.encode()).hexdigest()}
    (checkpoint / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "files", [{"adapter.safetensors": 3}, {}, [1], None, {"state.json": {"size": 1}}], ids=str
)  # fmt: skip
def test_a_checkpoint_whose_manifest_does_not_list_it_is_skipped(
    files: Any, tiny_job: Path, finished: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    out = shutil.copytree(finished, tmp_path / "run")
    newest = out / "checkpoints" / "step_00000002"
    (newest / "manifest.json").write_text(json.dumps({"step": 2, "files": files}))
    with pytest.warns(UserWarning, match="skipping a torn checkpoint"):
        assert resumed(tiny_job, out) == 1
    assert (out / "adapter.safetensors").read_bytes() == (finished / "adapter.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("state.json", '{"step": 2, "config": []}', "is no run state .config holds no settings by name"),
        ("state.json", '{"step": 2, "config": {"optimiser": []}}', "is no run state .config holds no settings"),
        ("state.json", '{"step": -3, "config": {}}', "is no run state .step is -3.*take an earlier checkpoint"),
        ("state.json", '{"step": "x", "config": {}}', "is no run state .step is 'x'"),
        ("optimiser.safetensors", "abc", "optimiser.safetensors cannot be read .*take an earlier checkpoint"),
    ],
    ids=["list", "section", "negative", "text", "moments"],
)
def test_a_state_that_is_none_is_named(
    name: str, text: str, message: str, tiny_job: Path, finished: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    out = shutil.copytree(finished, tmp_path / "run")
    newest = out / "checkpoints" / "step_00000002"
    listed(newest, name, text)
    assert newest_checkpoint(out / "checkpoints", wanted=FILES) == newest
    with pytest.raises(DataError, match=message):
        resumed(tiny_job, out)
    if name == "state.json":
        with pytest.raises(AnimaticError, match=message):
            read_state(newest)


def test_a_start_that_cannot_write_the_metrics_keeps_their_history(
    tiny_job: Path, finished: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    """As a kill while they are written: what was there is there."""
    out = shutil.copytree(finished, tmp_path / "run")

    def cut_short(_: int) -> str:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))
        try:
            resumed(tiny_job, out)
        except StorageError as error:
            return str(error)
        return "it was written"

    (told,) = in_children(1, cut_short)
    assert "file too large" in told
    assert (out / METRICS).read_bytes() == (finished / METRICS).read_bytes()


@pytest.mark.parametrize("renames", [0, 1, 2])
def test_a_kill_while_a_step_is_saved_again_leaves_one_whole(tmp_path: Path, monkeypatch, renames: int) -> None:
    save_checkpoint(tmp_path, 1, {"a": b"first"}, keep=1)
    rename, done = Path.rename, []

    def killed(path: Path, goal: Path) -> Path:
        if len(done) == renames:
            raise KeyboardInterrupt
        done.append(goal)
        return rename(path, goal)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed)
        if renames == 2:
            patch.setattr(checkpoints, "_prune", lambda *_, **__: killed(tmp_path, tmp_path))
        with pytest.raises(KeyboardInterrupt):
            save_checkpoint(tmp_path, 1, {"a": b"second"}, keep=1)
    whole = newest_checkpoint(tmp_path, wanted=["a"])
    assert whole is not None and (whole / "a").read_bytes() == (b"second" if renames == 2 else b"first")
    save_checkpoint(tmp_path, 1, {"a": b"third"}, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["step_00000001"]
    assert (tmp_path / "step_00000001" / "a").read_bytes() == b"third"


@pytest.mark.parametrize("left", ["an earlier one", "none"])
def test_a_kill_between_the_last_checkpoint_and_the_adapter_leaves_the_last_adapter(
    left: str, tiny_job: Path, finished: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    """There is no step left to do, so nothing else would put it there."""
    out = shutil.copytree(finished, tmp_path / "run")
    whole = (out / ADAPTER).read_bytes()
    (out / ADAPTER).unlink()
    if left != "none":
        shutil.copy(out / "checkpoints" / "step_00000001" / ADAPTER, out / ADAPTER)
    assert resumed(tiny_job, out) == 2
    assert (out / ADAPTER).read_bytes() == whole
    progress = read_progress(out)
    assert progress is not None and progress.finished


def test_what_a_kill_left_beside_the_adapter_is_swept(tiny_job: Path, finished: Path, tmp_path: Path) -> None:  # noqa: F811
    from dataset.receipts import host_name

    out = shutil.copytree(finished, tmp_path / "run")
    (dead,) = in_children(1, lambda _: os.getpid())
    kept = {".notes.txt", f".adapter.safetensors.{host_name()}-{os.getppid()}.tmp"}
    gone = {f".adapter.safetensors.{host_name()}-{dead}.tmp", ".adapter.safetensors.x7_ab2cd"}
    for name in kept | gone:
        (out / name).write_bytes(b"half")
    resumed(tiny_job, out)
    assert {path.name for path in out.iterdir() if path.name.startswith(".")} == kept


def test_what_a_kill_left_among_latents_is_swept(tmp_path: Path) -> None:
    from dataset.receipts import host_name

    job = cached_job(tmp_path / "job")
    (clip,) = (job / "latents" / "tiny").rglob("street_0.safetensors")
    (dead,) = in_children(1, lambda _: os.getpid())
    half = clip.with_name(f".{clip.name}.{host_name()}-{dead}.tmp")
    half.write_bytes(b"half")
    cached_job(job)
    assert clip.is_file() and not half.exists()


@pytest.mark.parametrize("trackers", [[], ["tensorboard"]], ids=["metrics alone", "tensorboard"])
@pytest.mark.parametrize("cause", ["no job", "no clips of it", "weights"])
def test_a_training_that_is_refused_makes_nothing(
    cause: str, trackers: list[str], tiny_job: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    job = tmp_path / "Q5"
    if cause == "no clips of it":
        job.mkdir()
    if cause == "weights":
        shutil.copytree(tiny_job / "latents" / "tiny", job / "latents" / "tiny")
    before = sorted(tmp_path.rglob("*"))
    config = tiny_config("motion", trackers=trackers)
    if cause == "weights":
        absent = config.backbone.model_copy(update={"weights": "none/there"})
        config = config.model_copy(update={"backbone": absent})
    with pytest.raises(AnimaticError):
        train(config, data=job, out=job / "adapters" / "tiny_motion", quiet=True)
    assert sorted(tmp_path.rglob("*")) == before


def test_missing_latents_are_told_with_the_command_that_makes_them(tmp_path: Path) -> None:
    words = r"is no job: .* label .*`animatic cache .*--backbone tiny`"
    with pytest.raises(DataError, match=f"Q5 {words}"):
        LatentStore(tmp_path / "Q5" / "latents" / "tiny")
    job = tmp_path / "not yet"
    job.mkdir()
    with pytest.raises(DataError, match=f"not yet {words}"):
        LatentStore(job / "latents" / "tiny")
    (job / "shards").mkdir()
    with pytest.raises(DataError, match=r"no latents for backbone tiny; .* cache '.*/not yet' --backbone tiny`"):
        LatentStore(job / "latents" / "tiny")
    with pytest.raises(DataError, match=r"for backbone mine; .* --backbone FILE`, FILE being the YAML that says what"):
        LatentStore(job / "latents" / "mine")

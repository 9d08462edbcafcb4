"""The trainer: the loss falls, resume is exact, the number of processes changes nothing, and trouble is handled."""

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate import Accelerator
from training_fixtures import PICTURE, in_children, one_thread, tiny_config, tiny_job  # noqa: F401

from labeling.errors import ConfigError, DataError, StorageError
from training.adapters import activate_adapter
from training.backbones import load_backbone
from training.batches import Draw, StepBatches, TrainingItems, collate
from training.checkpoints import list_checkpoints, newest_checkpoint, save_checkpoint
from training.config import Stage, TrainConfig
from training.guards import TrainingError, memory_advice, memory_knobs
from training.latents import open_store
from training.run_log import RunLog, read_metrics
from training.run_state import RunState, config_differences, read_state
from training.trainer import Trainer, TrainSummary, train
from training.validation import HELD_OUT


def run(config: TrainConfig, data: Path, out: Path, **settings: Any) -> TrainSummary:
    summary = train(config, data=data, out=out, quiet=True, **settings)
    assert isinstance(summary, TrainSummary)
    return summary


def files_of(checkpoint: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(checkpoint.iterdir())}


def tensorboard_scalars(folder: Path) -> dict[str, list[float]]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = {}
    # Settings go to a file of their own.
    for file in folder.rglob("events.out.tfevents*"):
        events = EventAccumulator(str(file))
        events.Reload()
        found |= {tag: [event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    return found


@pytest.mark.parametrize("stage", ["motion", "appearance", "end_to_end"])
def test_the_loss_falls_and_the_adapter_is_what_was_trained(stage, tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config(
        stage, optimiser={"steps": 30}, validation={"loss_every_steps": 15, "sigmas": (0.3, 0.7)},
        trackers=["tensorboard"],
    )  # fmt: skip
    summary = run(config, tiny_job, tmp_path)
    assert sum(summary.losses[-5:]) < 0.9 * sum(summary.losses[:5])
    metrics = read_metrics(tmp_path)
    held_out = [line["held_out/mean"] for line in metrics if "held_out/mean" in line]
    assert len(held_out) == 2 and held_out[1] < held_out[0]
    assert [line["loss"] for line in metrics if "loss" in line] == pytest.approx(list(summary.losses))
    shown = tensorboard_scalars(tmp_path)
    assert shown["loss"] == pytest.approx(list(summary.losses), rel=1e-6)
    assert shown["held_out/mean"] == pytest.approx(held_out, rel=1e-6)
    assert {"learning_rate", "gradient_norm", "samples_per_second", "peak_memory_gib"} <= set(shown)
    # The adapter file, on a fresh backbone, gives the last held-out loss again.
    backbone = load_backbone(config.backbone)
    backbone.load_adapter(summary.adapter, stage)
    activate_adapter(backbone.denoiser, stage)
    store = open_store(tiny_job, config.backbone)
    items = TrainingItems(store, store.keys("train"), config)
    losses = [
        backbone.losses(
            item.inputs, item.target_BCFHW, noise_BCFHW=item.noise_BCFHW, sigma_B=torch.tensor([sigma])
        ).detach()
        for item in (items.item(key, "held-out", held_out=True) for key in store.keys("val"))
        for sigma in (0.3, 0.7)
    ]
    assert float(torch.stack(losses).mean()) == pytest.approx(held_out[1], rel=1e-5)


@pytest.mark.parametrize("workers", [0, 2], ids=["no workers", "2 workers"])
def test_kill_9_and_resume_equals_an_undisturbed_run_bit_for_bit(
    workers: int, tiny_job: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    config = tiny_config(
        "motion", optimiser={"steps": 6, "schedule": "cosine"}, checkpoint={"every_steps": 3}, adapter={"dropout": 0.1},
        loader_workers=workers,
    )  # fmt: skip
    whole, broken = tmp_path / "whole", tmp_path / "broken"

    def undisturbed(_: int) -> list[float]:
        return list(run(config, tiny_job, whole).losses)

    def killed(_: int) -> None:
        run(
            config,
            tiny_job,
            broken,
            on_step=lambda step, _: os.kill(os.getpid(), signal.SIGKILL) if step == 5 else None,
        )

    def resumed(_: int) -> list[float]:
        summary = run(config, tiny_job, broken)
        assert summary.started_at == 3
        return list(summary.losses)

    (losses,) = in_children(1, undisturbed)
    assert in_children(1, killed) == [None]
    assert [path.name for path in list_checkpoints(broken / "checkpoints")] == ["step_00000003"]
    (later,) = in_children(1, resumed)
    assert later == losses[3:]
    assert files_of(whole / "checkpoints/step_00000006") == files_of(broken / "checkpoints/step_00000006")
    assert (whole / "adapter.safetensors").read_bytes() == (broken / "adapter.safetensors").read_bytes()
    steps = [line["step"] for line in read_metrics(broken)]
    assert steps == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("steps", [3, 6], ids=["last", "not last"])
def test_a_held_out_loss_that_a_kill_prevented_is_told_by_the_next_try(
    steps: int, tiny_job: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch  # noqa: F811
) -> None:  # fmt: skip
    config = tiny_config(
        "motion", optimiser={"steps": steps}, checkpoint={"every_steps": 3}, validation={"loss_every_steps": 3}
    )
    whole = run(config, tiny_job, tmp_path / "whole")

    def killed(*_: object, **__: object) -> dict[str, float]:
        raise RuntimeError("killed")

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
        patch.setattr("training.trainer.held_out_losses", killed)
        run(config, tiny_job, tmp_path / "broken")
    assert run(config, tiny_job, tmp_path / "broken").held_out == whole.held_out
    curves = [
        [(line["step"], line[HELD_OUT]) for line in read_metrics(tmp_path / name) if HELD_OUT in line]
        for name in ("whole", "broken")
    ]
    assert curves[0] == curves[1] and len(curves[0]) == steps // 3
    # What is there is not told again.
    run(config, tiny_job, tmp_path / "broken")
    assert sum(HELD_OUT in line for line in read_metrics(tmp_path / "broken")) == steps // 3


def test_1_2_and_4_processes_have_the_same_losses(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config("motion", optimiser={"steps": 3, "global_batch": 4, "micro_batch": 2})
    losses = {}
    for count in (1, 2, 4):
        found = in_children(count, lambda _, count=count: list(run(config, tiny_job, tmp_path / str(count)).losses))
        assert all(one == found[0] for one in found), "processes of one run disagree"
        losses[count] = found[0]
    assert losses[2] == pytest.approx(losses[1], rel=1e-5)
    assert losses[4] == pytest.approx(losses[1], rel=1e-5)


def test_a_resume_with_unequal_shares_equals_an_undisturbed_run(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    """Three samples a step over two processes: one of them has two micro-batches, the other one."""
    config = tiny_config(
        "motion", optimiser={"steps": 5, "global_batch": 3, "micro_batch": 1}, checkpoint={"every_steps": 2, "keep": 9}
    )
    whole = in_children(2, lambda _: list(run(config, tiny_job, tmp_path / "whole").losses))
    checkpoint = tmp_path / "whole" / "checkpoints" / "step_00000002"
    rest = in_children(2, lambda _: list(run(config, tiny_job, tmp_path / "rest", resume=checkpoint).losses))
    assert rest == [whole[0][2:]] * 2
    last = "checkpoints/step_00000005"
    assert files_of(tmp_path / "whole" / last) == files_of(tmp_path / "rest" / last)


def test_states_of_older_checkpoints_are_read(tmp_path: Path) -> None:
    older = {"step": 7, "config": {"seed": 1}, "loader": {"yielded": 9}, "loader_start": 0, "layout": {"workers": 2}}
    (tmp_path / "state.json").write_text(json.dumps(older))
    assert read_state(tmp_path) == RunState(step=7, config={"seed": 1})


def test_accumulation_changes_nothing_but_rounding(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    losses = [
        run(
            tiny_config("appearance", optimiser={"global_batch": 4, "micro_batch": size}),
            tiny_job,
            tmp_path / str(size),
        )
        for size in (1, 3, 4)
    ]
    for one in losses[1:]:
        assert one.losses == pytest.approx(losses[0].losses, rel=1e-5)


def test_loader_workers_and_checkpointing_change_nothing(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    plain = run(tiny_config("motion"), tiny_job, tmp_path / "plain")
    other = run(tiny_config("motion", loader_workers=2, gradient_checkpointing=True), tiny_job, tmp_path / "other")
    assert other.losses == pytest.approx(plain.losses, rel=1e-6)


def test_a_resume_with_other_workers_goes_on_with_the_same_samples(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config("motion", optimiser={"steps": 4}, checkpoint={"every_steps": 2, "keep": 9})
    whole = run(config, tiny_job, tmp_path)
    other = config.model_copy(update={"loader_workers": 1})
    again = run(other, tiny_job, tmp_path / "again", resume=tmp_path / "checkpoints" / "step_00000002")
    assert again.losses == whole.losses[2:]


def test_ctrl_c_saves_first_and_the_run_goes_on(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config("motion", checkpoint={"every_steps": 100})
    whole = run(config, tiny_job, tmp_path / "whole")
    cut = run(
        config, tiny_job, tmp_path / "cut",
        on_step=lambda step, _: os.kill(os.getpid(), signal.SIGINT) if step == 1 else None,
    )  # fmt: skip
    assert cut.interrupted and cut.steps == 2
    rest = run(config, tiny_job, tmp_path / "cut")
    assert (*cut.losses, *rest.losses) == whole.losses


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "terminated"])
def test_a_signal_to_the_whole_group_lets_the_step_end_first(number, tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    """A terminal interrupts loader workers too, whose batches the step still needs."""
    config = tiny_config(
        "motion", optimiser={"steps": 40, "global_batch": 8, "micro_batch": 1}, checkpoint={"every_steps": 100},
        loader_workers=2,
    )  # fmt: skip

    def interrupted(_: int) -> tuple[int, bool]:
        os.setpgrp()
        summary = run(
            config, tiny_job, tmp_path,
            on_step=lambda step, _: os.killpg(0, number) if step == 1 else None,
        )  # fmt: skip
        return summary.steps, summary.interrupted

    assert in_children(1, interrupted) == [(2, True)]
    assert newest_checkpoint(tmp_path / "checkpoints") == tmp_path / "checkpoints" / "step_00000002"


def test_a_loss_that_is_no_number_stops_with_the_last_checkpoint_intact(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config("motion", checkpoint={"every_steps": 2})
    backbone = load_backbone(config.backbone)
    losses = backbone.losses
    calls = []

    def poisoned(*arguments: Any, **named: Any) -> torch.Tensor:
        calls.append(1)
        return losses(*arguments, **named) * (float("nan") if len(calls) > 5 else 1.0)

    backbone.losses = poisoned  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match="not a number at step"):
        run(config, tiny_job, tmp_path, backbone=backbone)
    good = newest_checkpoint(tmp_path / "checkpoints")
    assert good is not None and good.name == "step_00000002"
    assert torch.isfinite(torch.tensor(run(config, tiny_job, tmp_path).losses)).all()


def test_out_of_memory_says_which_knobs_to_turn_in_order(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config("motion", adapter={"rank": 128})
    backbone = load_backbone(config.backbone)

    def full(*_: Any, **__: Any) -> torch.Tensor:
        raise torch.OutOfMemoryError("CUDA out of memory")

    backbone.losses = full  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match="micro_batch to 1.*gradient_checkpointing.*rank from 128.*fewer frames"):
        run(config, tiny_job, tmp_path, backbone=backbone)
    thrifty = tiny_config("motion", optimiser={"micro_batch": 1}, gradient_checkpointing=True, adapter={"rank": 8})
    assert not any("micro_batch" in knob or "gradient" in knob or "rank" in knob for knob in memory_knobs(thrifty))


def test_an_adapter_that_is_too_large_gets_the_same_advice(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config("motion", adapter={"rank": 128})
    backbone = load_backbone(config.backbone)

    def full(*_: Any) -> list[torch.nn.Parameter]:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 1 bytes")

    backbone.attach = full  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match="lower adapter.rank from 128"):
        run(config, tiny_job, tmp_path / "out", backbone=backbone)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory"),
        RuntimeError("CUBLAS_STATUS_ALLOC_FAILED"),
    ],
    ids=["python", "cpu", "cublas"],
)  # fmt: skip
def test_other_ways_to_run_out_of_memory_get_the_same_advice(error: Exception) -> None:
    with pytest.raises(TrainingError, match="in this order"), memory_advice(tiny_config("motion")):
        raise error
    with pytest.raises(RuntimeError, match="shapes"), memory_advice(tiny_config("motion")):
        raise RuntimeError("shapes differ")


def test_the_line_tells_loss_speed_time_left_and_memory(tmp_path: Path, capsys) -> None:
    log = RunLog(Accelerator(cpu=True), tmp_path, steps=4, start=0, samples_per_step=8, quiet=False)
    with log:
        log.step(2, {"loss": 0.1234})
    line = " ".join(capsys.readouterr().err.split())
    for part in ("2/4", "loss 0.1234", "steps/s", "samples/s", "GiB"):
        assert part in line
    assert ":" in line.split("samples/s")[1], "no time left"


def test_torn_checkpoints_are_skipped_with_a_warning_and_the_last_n_are_kept(tmp_path: Path) -> None:
    for step in range(1, 6):
        save_checkpoint(tmp_path, step, {"a": bytes(100), "b": bytes([step])}, keep=3)
    assert [path.name[-1] for path in list_checkpoints(tmp_path)] == ["3", "4", "5"]
    (tmp_path / "step_00000005" / "a").write_bytes(bytes(99))
    (tmp_path / "step_00000004" / "b").write_bytes(b"x")
    with pytest.warns(UserWarning, match="torn checkpoint"):
        assert newest_checkpoint(tmp_path) == tmp_path / "step_00000003"
    (tmp_path / "step_00000003" / "manifest.json").unlink()
    with pytest.warns(UserWarning, match="torn"):
        assert newest_checkpoint(tmp_path) is None


@pytest.mark.parametrize(("keep", "kept"), [(1, [3]), (2, [3, 9]), (3, [3, 8, 9])])
def test_the_checkpoint_just_written_is_never_pruned(tmp_path: Path, keep: int, kept: list[int]) -> None:
    """A run that goes on from step 2 writes step 3 beside the 8 and 9 of the run before."""
    for step in (7, 8, 9):
        save_checkpoint(tmp_path, step, {"a": b"x"}, keep=3)
    save_checkpoint(tmp_path, 3, {"a": b"x"}, keep=keep)
    assert [int(path.name[-8:]) for path in list_checkpoints(tmp_path)] == kept


def test_a_save_that_fails_leaves_earlier_checkpoints_whole(tmp_path: Path, monkeypatch) -> None:
    from training import checkpoints

    save_checkpoint(tmp_path, 1, {"a": b"1"}, keep=1)
    write = checkpoints._write_synced

    def no_space(path: Path, data: bytes) -> None:
        if path.name == "manifest.json":
            raise OSError(28, "No space left on device")
        write(path, data)

    monkeypatch.setattr(checkpoints, "_write_synced", no_space)
    with pytest.raises(StorageError):
        save_checkpoint(tmp_path, 2, {"a": b"2"}, keep=1)
    assert newest_checkpoint(tmp_path) == tmp_path / "step_00000001"
    assert [path.name for path in tmp_path.iterdir()] == ["step_00000001"]


def test_resume_refuses_other_settings_and_never_refuses_a_used_folder(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    config = tiny_config("motion", checkpoint={"every_steps": 2})
    run(config, tiny_job, tmp_path)
    with pytest.raises(ConfigError, match=r"other settings \(seed, optimiser.learning_rate\)"):
        run(tiny_config("motion", seed=5, optimiser={"learning_rate": 1e-3}), tiny_job, tmp_path)
    with pytest.raises(ConfigError, match="already has checkpoints"):
        run(config, tiny_job, tmp_path, resume="never")
    assert run(config, tiny_job, tmp_path).losses == ()


def test_resume_refuses_other_data(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    """A finished adapter of labels that have changed since is none of theirs."""
    config = tiny_config("motion", checkpoint={"every_steps": 2})
    run(config, tiny_job, tmp_path)
    (log,) = (tiny_job / "latents").rglob("clips-*.jsonl")
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    changed = next(row for row in rows if row["split"] == "train") | {"source": "0" * 64, "turn": 9}
    copy = tmp_path / "job"
    shutil.copytree(tiny_job, copy)
    with (copy / log.relative_to(tiny_job)).open("a") as file:
        file.write(json.dumps(changed) + "\n")
    with pytest.raises(ConfigError, match="trained on other clips, labels or captions"):
        run(config, copy, tmp_path)
    assert run(config, tiny_job, tmp_path).losses == ()


@pytest.mark.parametrize(
    ("change", "seen"),
    [
        ({"picture": PICTURE | {"control_width": 192}}, ["picture.control_width"]),
        ({"dtype": "bfloat16", "text_tokens": 3, "seed": 7}, ["dtype", "seed", "text_tokens"]),
        ({"vae_tiling": True}, []),
    ],
    ids=["sizes", "network", "harmless"],
)  # fmt: skip
def test_a_resume_may_change_nothing_of_the_backbone_that_moves_the_losses(change, seen) -> None:
    held = tiny_config("motion").model_dump(mode="json")
    changed = config_differences(held, tiny_config("motion", backbone={"picture": PICTURE, **change}))
    assert sorted(changed) == [f"backbone.{name}" for name in seen]
    del held["backbone"]["vae_tiling"]
    assert config_differences(held, tiny_config("motion")) == []


def test_held_out_loss_does_not_depend_on_step_seed_of_order_or_dropout(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    """A learning rate next to nothing: the curve must be flat."""
    config = tiny_config(
        "motion", optimiser={"learning_rate": 1e-12}, validation={"loss_every_steps": 1}, adapter={"dropout": 0.5}
    )
    run(config, tiny_job, tmp_path)
    curve = [line["held_out/mean"] for line in read_metrics(tmp_path) if "held_out/mean" in line]
    assert len(curve) == 4
    assert max(curve) - min(curve) < 1e-6


def test_validation_videos_are_written(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    import cv2

    from labeling.video import frame_count

    config = tiny_config("motion", validation={"videos_every_steps": 2, "sampling_steps": 2})
    backbone = load_backbone(config.backbone)
    released: list[str] = []
    release = backbone.release
    backbone.release = lambda parts: (released.extend(parts), release(parts))[1]  # type: ignore[method-assign]
    run(config, tiny_job, tmp_path, backbone=backbone)
    assert released == ["vae"] * 3, "before the first step, and after the videos of steps 2 and 4"
    videos, sheets = (sorted((tmp_path / "validation").glob(f"*.{kind}")) for kind in ("mp4", "png"))
    assert [path.stem for path in videos] == ["step_00000002_other_0", "step_00000004_other_0"]
    assert frame_count(videos[0]) == 9
    sheet = cv2.imread(str(sheets[0]))
    assert sheet is not None and sheet.shape == (2 * 64, 8 * 96, 3)


def test_unknown_trackers_missing_latents_and_empty_splits_are_named(
    tiny_job: Path, tmp_path: Path, monkeypatch  # noqa: F811
) -> None:  # fmt: skip
    with pytest.raises(ConfigError, match="trackers notebook are not known.*tensorboard"):
        run(tiny_config("motion", trackers=["notebook"]), tiny_job, tmp_path)
    # accelerate knows wandb by name; where it is not installed it would be left out without a word.
    monkeypatch.setattr("training.trainer.get_available_trackers", list)
    with pytest.raises(ConfigError, match="pip install wandb"):
        run(tiny_config("motion", trackers=["wandb"]), tiny_job, tmp_path)
    with pytest.raises(DataError, match="animatic cache"):
        run(tiny_config("motion"), tmp_path, tmp_path / "out")
    with pytest.raises(DataError, match="stale.*picture"):
        run(tiny_config("motion", backbone={"picture": {**PICTURE, "rgb_width": 128}}), tiny_job, tmp_path)
    only_val = tmp_path / "only_val"
    from training_fixtures import fake_datasets

    from training.latents import cache_latents

    cache_latents(only_val, backbone_name="tiny", picture=PICTURE, datasets={"val": fake_datasets(0, 1)["val"]})
    with pytest.raises(DataError, match="no clips for training"):
        run(tiny_config("motion"), only_val, tmp_path / "out")


@pytest.mark.parametrize("trackers", [[], ["tensorboard"]], ids=["metrics alone", "tensorboard"])
def test_a_folder_that_cannot_be_written_to_is_named(trackers, tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    (tmp_path / "file").write_text("")
    (tmp_path / "taken" / "metrics.jsonl").mkdir(parents=True)
    (tmp_path / "taken" / "logs").write_text("")
    for out in (Path("/proc/none"), tmp_path / "file" / "run", tmp_path / "taken"):
        with pytest.raises(StorageError, match=f"{out}.*; give a folder that can be written to"):
            run(tiny_config("motion", trackers=trackers), tiny_job, out)


def test_order_covers_every_clip_each_epoch_and_is_shared_out_without_overlap() -> None:
    config = tiny_config("motion", optimiser={"steps": 6, "global_batch": 5, "micro_batch": 2})
    whole = [draw for batch in StepBatches(10, config=config) for draw in batch]
    assert sorted(draw.index for draw in whole[:10]) == list(range(10))
    assert [draw.index for draw in whole[:10]] != [draw.index for draw in whole[10:20]]
    shares = [[d for batch in StepBatches(10, config=config, rank=r, world_size=3) for d in batch] for r in range(3)]
    for step in range(6):
        parts = sorted((d.epoch, d.index) for share in shares for d in share if d.step == step)
        assert parts == sorted((d.epoch, d.index) for d in whole if d.step == step)


def test_a_sample_that_comes_twice_in_a_step_is_drawn_twice(tiny_job: Path) -> None:  # noqa: F811
    config = tiny_config("motion", optimiser={"global_batch": 8, "micro_batch": 8})
    store = open_store(tiny_job, config.backbone)
    items = TrainingItems(store, store.keys("train"), config)
    batch = next(iter(StepBatches(4, config=config)))
    drawn = [items[draw] for draw in batch if draw.index == 0]
    assert len(drawn) == 2
    assert not torch.equal(drawn[0].noise_BCFHW, drawn[1].noise_BCFHW)


def test_conditions_come_with_their_own_probabilities_and_together(tiny_job: Path) -> None:  # noqa: F811
    config = tiny_config(
        "motion", conditions={"ego_probability": 0.75, "objects_probability": 0.25, "caption_dropout": 0.1}
    )
    store = open_store(tiny_job, config.backbone)
    items = TrainingItems(store, store.keys("train"), config)
    given = [items.item(store.keys("train")[0], "train", step, 0).inputs for step in range(1500)]
    names = [frozenset(reference.name for reference in one.references) for one in given]
    shares = {name: sum(name in one for one in names) / len(names) for name in ("ego", "objects", "image")}
    assert shares == pytest.approx({"ego": 0.75, "objects": 0.25, "image": 1.0}, abs=0.04)
    both = sum({"ego", "objects"} <= one for one in names) / len(names)
    assert both == pytest.approx(0.75 * 0.25, abs=0.03)
    dropped = sum(int(one.text_mask_BL.sum()) == 1 for one in given) / len(given)
    assert dropped == pytest.approx(0.1, abs=0.03)


def test_the_skeletons_noise_is_not_the_targets_noise(tiny_job: Path, monkeypatch) -> None:  # noqa: F811
    """Else the network could read the noise that it is to find off its condition."""
    config = tiny_config("appearance", targeted_noise={"omega_max": 0.5})
    store = open_store(tiny_job, config.backbone)
    given: list[torch.Tensor] = []

    def watched(latents: torch.Tensor, *_: Any, noise_CFHW: torch.Tensor, **__: Any) -> torch.Tensor:
        given.append(noise_CFHW)
        return latents

    monkeypatch.setattr("training.batches.add_targeted_noise", watched)
    item = TrainingItems(store, store.keys("train"), config).item(store.keys("train")[0], 1)
    (noise,) = given
    target = item.noise_BCFHW[0]
    assert noise.shape == target.shape
    assert abs(float(torch.corrcoef(torch.stack([noise.flatten(), target.flatten()]))[0, 1])) < 0.2


def test_batches_hold_one_layout_and_keep_every_sample(tiny_job: Path) -> None:  # noqa: F811
    config = tiny_config("motion")
    store = open_store(tiny_job, config.backbone)
    items = TrainingItems(store, store.keys("train"), config)
    drawn = [items.item(key, "train", step, 0) for step in range(3) for key in store.keys("train")]
    batches = collate(drawn)
    assert len(batches) > 1
    assert sorted(key for batch in batches for key in batch.keys) == sorted(item.key for item in drawn)
    for batch in batches:
        assert len(batch.target_BCFHW) == len(batch.keys) == len(batch.inputs.text_BLD)


def test_the_checkpoint_manifest_is_the_last_word(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    run(tiny_config("motion", checkpoint={"every_steps": 4}), tiny_job, tmp_path)
    folder = tmp_path / "checkpoints" / "step_00000004"
    manifest = json.loads((folder / "manifest.json").read_text())
    assert set(manifest["files"]) == {"adapter.safetensors", "optimiser.safetensors", "state.json"}
    assert (tmp_path / "adapter.safetensors").read_bytes() == (folder / "adapter.safetensors").read_bytes()


def test_bfloat16_base_trains_float32_adapters(tmp_path: Path) -> None:
    from training_fixtures import fake_datasets

    from training.config import backbone_config
    from training.latents import cache_latents

    backbone = load_backbone(backbone_config("tiny", picture=PICTURE, dtype="bfloat16", latent_dtype="bfloat16"))
    cache_latents(tmp_path, backbone_name="tiny", backbone=backbone, datasets=fake_datasets(2, 0))
    config = tiny_config("motion", backbone={"dtype": "bfloat16", "latent_dtype": "bfloat16"}, optimiser={"steps": 10})
    trainer = Trainer(config, data=tmp_path, out=tmp_path / "out", quiet=True)
    losses = trainer.run().losses
    assert {one.dtype for one in trainer.parameters} == {torch.float32}
    assert {state["exp_avg"].dtype for state in trainer.optimiser.state.values()} == {torch.float32}
    frozen = [one for one in trainer.backbone.denoiser.parameters() if not one.requires_grad]
    assert {one.dtype for one in frozen} == {torch.bfloat16}
    assert losses[-1] < losses[0]


@pytest.mark.parametrize("limit", [1e-4, 0.0], ids=["clipped", "no limit"])
def test_gradients_are_clipped_to_the_limit_and_told_as_they_were(
    limit: float, tiny_job: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    config = tiny_config("motion", optimiser={"steps": 2, "max_gradient_norm": limit})
    trainer = Trainer(config, data=tiny_job, out=tmp_path, quiet=True)
    used: list[float] = []

    def watch(*_: Any) -> None:
        gradients = [one.grad for one in trainer.parameters if one.grad is not None]
        used.append(float(torch.nn.utils.get_total_norm(gradients)))

    trainer.optimiser.register_step_pre_hook(watch)
    trainer.run()
    told = [line["gradient_norm"] for line in read_metrics(tmp_path) if "gradient_norm" in line]
    assert len(told) == 2 and min(told) > 1e-3
    assert used == pytest.approx([limit] * 2 if limit else told, rel=1e-2 if limit else 1e-5)


@pytest.mark.parametrize("stage", ["motion", "appearance"])
def test_a_control_video_that_was_not_cached_is_told_before_a_folder_is_made(
    stage: Stage, tiny_job: Path, tmp_path: Path  # noqa: F811
) -> None:  # fmt: skip
    config = tiny_config(stage, conditions={"control": "hdmap"})
    with pytest.raises(DataError, match="holds skeleton videos, but none called hdmap; .* --controls hdmap --refresh"):
        train(config, data=tiny_job, out=tmp_path / "out", quiet=True)
    assert not (tmp_path / "out").exists()
    # The baseline sees no control video.
    baseline = tiny_config("end_to_end", conditions={"control": "hdmap"}, optimiser={"steps": 1})
    train(baseline, data=tiny_job, out=tmp_path / "out", quiet=True)


def test_fetching_ahead_keeps_order_and_errors() -> None:
    from torch.utils.data import DataLoader

    from training.prefetch import Prefetched

    config = tiny_config("motion", optimiser={"steps": 6, "global_batch": 2, "micro_batch": 1})

    class Numbers(torch.utils.data.Dataset):
        def __getitem__(self, draw: Draw) -> tuple[int, int]:
            if draw.step == 5:
                raise DataError("clip 5 is damaged")
            return draw.step, draw.index

        def __len__(self) -> int:
            return 7

    def loader(start_step: int = 0, *, workers: int = 0) -> DataLoader:
        batches = StepBatches(7, config=config, start_step=start_step)
        return DataLoader(Numbers(), batch_sampler=batches, collate_fn=lambda items: items[0], num_workers=workers)

    # Without the traceback that torch puts around what a worker raises.
    with Prefetched(loader(5, workers=1)) as torn, pytest.raises(DataError, match="^clip 5 is damaged$"):
        next(torn)

    with Prefetched(loader()) as ahead:
        seen = [next(ahead) for _ in range(4)]
    with Prefetched(loader(2)) as rest:
        seen += [next(rest) for _ in range(6)]
        assert [step for step, _ in seen] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
        with pytest.raises(DataError, match="damaged"):
            next(rest)
        with pytest.raises(StopIteration):
            next(rest)

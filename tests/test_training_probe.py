"""The step probe: counted work agrees with the formula, a measured step is a training step, attachment follows it."""

import pytest
import torch
from training_fixtures import PICTURE, one_thread, tiny_config  # noqa: F401

from training import tiny
from training.backbones import load_backbone
from training.dry_run import plan_run
from training.step_probe import StepProbe, counted_flops, measure_steps, random_inputs, random_ltx


@pytest.mark.parametrize("stage", ["motion", "appearance", "end_to_end"])
def test_the_plans_work_is_what_torch_counts(stage) -> None:
    config = tiny_config(
        stage, conditions={"ego_probability": 1.0, "objects_probability": 1.0}, adapter={"rank": 64},
        backbone={"text_tokens": 16, "picture": {**PICTURE, "frames": 9, "control_width": 192, "rgb_width": 192}},
        optimiser={"global_batch": 1, "micro_batch": 1},
    )  # fmt: skip
    counted = counted_flops(config, frames=9, settings=tiny.TINY_TRANSFORMER)
    planned = plan_run(config).petaflops_per_step * 1e15
    # The plan also sends gradients through the first layers, where none are needed.
    assert counted <= planned <= 1.12 * counted


def test_recomputation_is_work() -> None:
    config = tiny_config("motion")
    again = config.model_copy(update={"gradient_checkpointing": True})
    assert 1.25 < plan_run(again).petaflops_per_step / plan_run(config).petaflops_per_step < 1.5


def test_random_weights_are_the_seeds_and_finite() -> None:
    config = tiny_config("motion").backbone
    first, second = (random_ltx(config, settings=tiny.TINY_TRANSFORMER).denoiser.state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) and torch.isfinite(first[name]).all() for name in first)


@pytest.mark.parametrize("references", [("ego", "image"), None], ids=["two", "all"])
def test_random_inputs_hold_the_conditions_asked_for(references) -> None:
    config = tiny_config("motion", optimiser={"micro_batch": 2})
    inputs = random_inputs(config, references=references, frames=9)
    assert [one.name for one in inputs.references] == list(references or ("ego", "objects", "image"))
    assert len(inputs.text_BLD) == 2


@pytest.mark.parametrize("checkpointing", [False, True], ids=["kept", "recomputed"])
def test_probe_steps_train_the_adapter(checkpointing: bool) -> None:
    config = tiny_config("motion", gradient_checkpointing=checkpointing)
    made: list[StepProbe] = []

    def make() -> StepProbe:
        made.append(StepProbe(load_backbone(config.backbone), config, frames=9))
        return made[0]

    measure = measure_steps(make, steps=2)
    assert len(measure.ms) == 2 and min(measure.ms) > 0 and measure.peak_gib >= 0
    trained = [one.detach() for name, one in made[0].backbone.denoiser.named_parameters() if ".lora_B." in name]
    assert any(one.abs().sum() > 0 for one in trained), "B starts at zero"

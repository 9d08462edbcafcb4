"""The token sequence: layout, coordinates, clean tokens; the same in training and in sampling."""

from dataclasses import replace

import pytest
import torch
from diffusers.pipelines.ltx.pipeline_ltx_condition import LTXConditionPipeline
from training_fixtures import one_thread, tiny_config, tiny_job  # noqa: F401

from labeling.errors import ConfigError, DataError
from training.backbone import LatentGeometry, SamplingSettings, StageInputs, TextEmbedding, pad_text
from training.backbones import load_backbone
from training.batches import TrainingItems
from training.conditioning import (
    assemble_tokens,
    pack,
    sequence_coordinates,
    sequence_tokens,
    token_coordinates,
    unpack,
)
from training.config import Convention
from training.flow import interpolate, sampling_sigmas
from training.latents import open_store
from training.stages import stage_inputs

GEOMETRY = LatentGeometry(channels=128, spatial=32, temporal=8)
TEXT = TextEmbedding(tokens_LD=torch.ones(3, 32))


def latents(frames: int, height: int, width: int, *, value: float | None = None) -> torch.Tensor:
    shape = (128, frames, height, width)
    return torch.randn(shape) if value is None else torch.full(shape, value)


def motion_inputs(*names: str, frames: int = 3) -> StageInputs:
    references = {name: latents(frames, 2, 3) for name in names} | {"image": latents(1, 2, 3)}
    target = latents(frames, 2, 3)
    return stage_inputs(
        "motion", first_frame_CFHW=target, target_shape=(128, frames, 2, 3), references=references, text=TEXT,
        text_tokens=8, fps=24.0,
    )  # fmt: skip


@pytest.mark.parametrize("names", [(), ("ego",), ("objects",), ("ego", "objects")], ids=str)
def test_motion_sequence_is_controls_then_image_then_target(names: tuple[str, ...]) -> None:
    inputs = motion_inputs(*names)
    assert [reference.name for reference in inputs.references] == [*names, "image"]
    sequence = assemble_tokens(inputs, latents(3, 2, 3)[None], sigma_B=torch.tensor([0.5]), geometry=GEOMETRY)
    assert sequence.target_start == len(names) * 18 + 6
    assert sequence.hidden_BNC.shape == (1, sequence.target_start + 18, 128)
    assert sequence_tokens(inputs) == (18, sequence.target_start + 18)
    image_start = sequence.target_start - 6
    image = sequence.coordinates_B3N[0, 0, image_start : sequence.target_start]
    assert image.tolist() == pytest.approx([8 * 1000 / 24] * 6)


def test_references_and_first_frame_are_clean_and_carry_timestep_0() -> None:
    inputs = motion_inputs("ego", "objects")
    noisy = latents(3, 2, 3)[None]
    sequence = assemble_tokens(inputs, noisy, sigma_B=torch.tensor([0.25]), geometry=GEOMETRY)
    clean = sequence.target_start + 6
    assert (sequence.timestep_BN[0, :clean] == 0).all()
    assert (sequence.timestep_BN[0, clean:] == 250).all()
    assert torch.equal(sequence.hidden_BNC[:, sequence.target_start : clean], pack(inputs.first_frame_BCFHW))
    assert torch.equal(sequence.hidden_BNC[:, clean:], pack(noisy)[:, 6:])
    assert sequence.loss_mask_BN[0].tolist() == [False] * 6 + [True] * 12


def test_coordinates_are_seconds_rows_and_columns() -> None:
    coordinates = token_coordinates((2, 2, 3), fps=24.0, geometry=GEOMETRY)
    assert coordinates[:, 0].tolist() == [0, 0, 0]
    assert coordinates[:, -1].tolist() == pytest.approx([8 / 24, 32, 64])
    assert coordinates[1].view(2, 2, 3)[1].tolist() == [[0, 0, 0], [32, 32, 32]]


def test_consistent_references_lie_on_the_targets_grid() -> None:
    """The appearance stage's 768x512 skeleton and 1056x704 target: same place, same coordinates."""
    inputs = stage_inputs(
        "appearance", first_frame_CFHW=latents(1, 22, 33), target_shape=(128, 2, 22, 33), text=TEXT, text_tokens=8,
        references={"skeleton": latents(2, 16, 24)}, fps=24.0,
    )  # fmt: skip
    coordinates = sequence_coordinates(inputs, geometry=GEOMETRY)
    skeleton, target = coordinates[:, : 2 * 16 * 24], coordinates[:, 2 * 16 * 24 :]
    # The far edge of the last cell, in the target's pixels.
    assert float(skeleton[1].max()) + 32 * 22 / 16 == pytest.approx(704)
    assert float(skeleton[2].max()) + 32 * 33 / 24 == pytest.approx(1056)
    assert skeleton[0].unique().tolist() == target[0].unique().tolist()
    released = sequence_coordinates(inputs, geometry=GEOMETRY, convention="released")
    assert float(released[1, : 2 * 16 * 24].max()) == 15 * 32


def test_released_coordinates_are_what_diffusers_samples_with() -> None:
    ids = LTXConditionPipeline._prepare_video_ids(1, 4, 2, 3)
    stock = LTXConditionPipeline._scale_video_ids(ids).float()[0]
    stock[0] /= 24
    assert torch.equal(token_coordinates((4, 2, 3), fps=24.0, geometry=GEOMETRY, convention="released"), stock)


def test_pack_and_unpack_are_inverse_and_agree_with_diffusers() -> None:
    video = torch.randn(2, 5, 3, 2, 4)
    assert torch.equal(unpack(pack(video), (5, 3, 2, 4)), video)
    assert torch.equal(pack(video), LTXConditionPipeline._pack_latents(video))


@pytest.mark.parametrize("stage", ["motion", "appearance", "end_to_end"])
def test_training_and_sampling_feed_the_same_tokens_at_the_same_sigma(stage, tiny_job, monkeypatch) -> None:  # noqa: F811
    """A network that answers v = eps - z exactly leads the sampler along the very states that training draws."""
    config = tiny_config(stage, targeted_noise={"omega_max": 0})
    backbone = load_backbone(config.backbone)
    store = open_store(tiny_job, config.backbone)
    item = TrainingItems(store, store.keys("train"), config).item(store.keys("train")[0], "parity", held_out=True)
    fed: list[dict[str, torch.Tensor]] = []
    true_velocity = pack(item.noise_BCFHW - item.target_BCFHW)

    def answer(**given: torch.Tensor):
        fed.append({name: value.clone() for name, value in given.items() if isinstance(value, torch.Tensor)})
        padding = given["hidden_states"].shape[1] - true_velocity.shape[1]
        return (torch.nn.functional.pad(true_velocity, (0, 0, padding, 0)),)

    monkeypatch.setattr(backbone.denoiser, "forward", answer)
    settings = SamplingSettings(steps=5, guidance=1.0)
    backbone.sample(item.inputs, noise_BCFHW=item.noise_BCFHW, empty_text=store.text(""), settings=settings)
    sampled, fed = fed, []
    for sigma in sampling_sigmas(5, tokens=sequence_tokens(item.inputs)[0])[:-1]:
        loss = backbone.losses(item.inputs, item.target_BCFHW, noise_BCFHW=item.noise_BCFHW, sigma_B=sigma[None])
        assert float(loss) == 0
    assert len(fed) == len(sampled) == 5
    for trained, drawn in zip(fed, sampled, strict=True):
        assert trained.keys() == drawn.keys()
        for name, value in trained.items():
            torch.testing.assert_close(drawn[name], value, rtol=0, atol=1e-5 if name == "hidden_states" else 0)


def test_guidance_goes_from_the_empty_texts_velocity_through_the_texts(tiny_job) -> None:  # noqa: F811
    """One Euler step is linear in the velocity: 0 is the empty text's, 1 the text's, 3 on the line through both."""
    config = tiny_config("motion")
    backbone = load_backbone(config.backbone)
    store = open_store(tiny_job, config.backbone)
    key, empty = store.keys("train")[0], store.text("")
    item = TrainingItems(store, store.keys("train"), config).item(key, "guided", held_out=True)
    empty_BLD, empty_mask_BL = pad_text([empty], length=config.backbone.text_tokens)
    silent = replace(item.inputs, text_BLD=empty_BLD, text_mask_BL=empty_mask_BL)

    def sampled(inputs: StageInputs, guidance: float) -> torch.Tensor:
        settings = SamplingSettings(steps=1, guidance=guidance)
        return backbone.sample(inputs, noise_BCFHW=item.noise_BCFHW, empty_text=empty, settings=settings)

    without, with_text = sampled(silent, 1.0), sampled(item.inputs, 1.0)
    assert float((with_text - without).abs().max()) > 1e-3
    torch.testing.assert_close(sampled(item.inputs, 0.0), without, rtol=0, atol=1e-5)
    # 1 itself is a shortcut past the formula.
    torch.testing.assert_close(sampled(item.inputs, 1 + 1e-6), with_text, rtol=0, atol=1e-5)
    torch.testing.assert_close(sampled(item.inputs, 3.0), without + 3 * (with_text - without), rtol=0, atol=1e-4)


def test_released_coordinates_change_what_the_sampler_feeds() -> None:
    inputs = motion_inputs("ego")
    expectations: dict[Convention, float] = {"consistent": 8 / 24, "released": 1 / 24}
    for convention, expected in expectations.items():
        sequence = assemble_tokens(
            inputs, latents(3, 2, 3)[None], sigma_B=torch.ones(1), geometry=GEOMETRY, convention=convention
        )
        assert float(sequence.coordinates_B3N[0, 0, sequence.target_start + 6]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("stage", "references"),
    [("motion", {}), ("appearance", {}), ("appearance", {"ego": 1}), ("end_to_end", {"image": 1})],
    ids=["motion without image", "appearance without skeleton", "appearance with ego", "end_to_end with image"],
)
def test_wrong_conditions_are_refused(stage, references) -> None:
    given = {name: latents(1, 2, 3) for name in references}
    with pytest.raises(DataError, match=f"{stage} stage takes"):
        stage_inputs(
            stage, first_frame_CFHW=latents(1, 2, 3), target_shape=(128, 1, 2, 3), references=given, text=TEXT,
            text_tokens=8, fps=24.0,
        )  # fmt: skip


@pytest.mark.parametrize("frames", [120, 0, 2, 8])
def test_frame_counts_that_are_not_8k_plus_1_are_errors(frames: int) -> None:
    with pytest.raises(ConfigError, match=f"{frames} frames do not fit.*8k\\+1"):
        GEOMETRY.latent_shape(frames=frames, height=64, width=96)


@pytest.mark.parametrize(("height", "width"), [(500, 768), (512, 770), (0, 32)])
def test_sizes_that_32_does_not_divide_are_errors(height: int, width: int) -> None:
    with pytest.raises(ConfigError, match="multiples of 32"):
        GEOMETRY.latent_shape(frames=121, height=height, width=width)


def test_token_counts_of_the_released_sizes() -> None:
    for (height, width), count in {(512, 768): 6144, (704, 1056): 11616}.items():
        _, frames, rows, columns = GEOMETRY.latent_shape(frames=121, height=height, width=width)
        assert frames * rows * columns == count


def test_interpolation_runs_from_clean_to_noise() -> None:
    clean, noise = torch.zeros(2, 1, 2, 2, 2), torch.ones(2, 1, 2, 2, 2)
    mixed = interpolate(clean, noise, torch.tensor([0.0, 0.75]))
    assert float(mixed[0].max()) == 0
    assert float(mixed[1].mean()) == 0.75

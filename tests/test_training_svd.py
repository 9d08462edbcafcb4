"""The SVD recipe: conditions as channels that start at zero, text that starts silent, EDM, the same trainer."""

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import EulerDiscreteScheduler
from training_fixtures import FakeSample, fake_datasets, one_thread  # noqa: F401

from labeling.errors import ModelError
from training.adapters import activate_adapter
from training.backbone import Reference, SamplingSettings, StageInputs
from training.backbones import load_backbone
from training.batches import TrainingItems
from training.config import backbone_config, load_config
from training.dry_run import plan_run
from training.generation import ClipConditions, ClipGenerator
from training.latents import cache_latents, open_store
from training.svd import SVD_GEOMETRY, SvdBackbone, assemble_channels, karras_sigmas
from training.trainer import TrainSummary, train

OVERRIDES = {
    "backbone": {"name": "tiny-svd"},
    "trackers": [],
    "optimiser": {"steps": 4, "global_batch": 2, "micro_batch": 2},
}


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("svd_job")
    cache_latents(folder, backbone_name="tiny-svd", datasets=fake_datasets(2, 1))
    return folder


@pytest.fixture
def backbone() -> SvdBackbone:
    loaded = load_backbone(backbone_config("tiny-svd"))
    assert isinstance(loaded, SvdBackbone)
    return loaded


def inputs(*names: str, frames: int = 5) -> StageInputs:
    latents = torch.randn(2, 4, frames, 8, 12)
    return StageInputs(
        target_shape=(4, frames, 8, 12), first_frame_BCFHW=latents[:, :, :1], slots=("ego", "objects", "image"),
        references=tuple(
            Reference(name=name, latents_BCFHW=latents[:, :, :1] if name == "image" else latents) for name in names
        ),
        text_BLD=torch.randn(2, 6, 32), text_mask_BL=torch.ones(2, 6, dtype=torch.bool), fps=12.0,
        image_B1D=torch.randn(2, 1, 32),
    )  # fmt: skip


def test_every_second_frame_of_the_first_seconds(job: Path) -> None:
    store = open_store(job, backbone_config("tiny-svd"))
    assert (store.manifest.frames, store.fps) == (5, 12.0)
    latents = store.read("street_0", ["rgb", "image", "skeleton", "image_embedding"])
    assert latents["rgb"].shape == (4, 5, 8, 12) and latents["image_embedding"].shape == (1, 32)
    ours = load_backbone(backbone_config("tiny-svd"))
    frames = FakeSample(key="street_0").frames("rgb.mp4")[::2]
    assert torch.equal(latents["rgb"], ours.encode_video(frames))


def test_channels_hold_target_first_frame_and_references_with_zeros_for_the_absent() -> None:
    given = inputs("objects", "image")
    noisy, sigma = torch.randn(2, 4, 5, 8, 12), torch.tensor([0.5, 3.0])
    channels = assemble_channels(given, noisy, sigma_B=sigma).transpose(1, 2)
    assert channels.shape == (2, 20, 5, 8, 12)
    for row in range(2):
        torch.testing.assert_close(channels[row, :4], noisy[row] / (sigma[row] ** 2 + 1).sqrt())
    first = given.first_frame_BCFHW[:, :, 0] / 0.18215
    assert all(torch.equal(channels[:, 4:8, frame], first) for frame in range(5))
    assert not channels[:, 8:12].any()
    assert torch.equal(channels[:, 12:16], given.references[0].latents_BCFHW)


def test_a_fresh_adapter_leaves_the_network_as_it_was(backbone: SvdBackbone) -> None:
    """Zero-initialised channels and text: with and without the adapter the answers are the same."""
    given, noisy, sigma = inputs("ego", "image"), torch.randn(2, 4, 5, 8, 12), torch.tensor([0.5, 3.0])
    with torch.no_grad():
        before = backbone.denoised(given, noisy, sigma_B=sigma)
        backbone.attach("motion", load_config("tiny", stage="motion").adapter)
        after = backbone.denoised(given, noisy, sigma_B=sigma)
        torch.testing.assert_close(after, before, rtol=0, atol=1e-5)
        for layer in (backbone.denoiser.conv_in, backbone.denoiser.text_projection):
            torch.nn.init.normal_(layer.per_adapter["motion"].weight)  # type: ignore[union-attr, index]
        changed = backbone.denoised(given, noisy, sigma_B=sigma)
        assert float((changed - before).abs().max()) > 1e-3
        activate_adapter(backbone.denoiser, None)
        assert torch.equal(backbone.denoised(given, noisy, sigma_B=sigma), before)


def test_noise_levels_are_diffusers_karras_sigmas() -> None:
    stock = EulerDiscreteScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", prediction_type="v_prediction",
        timestep_type="continuous", use_karras_sigmas=True, sigma_min=0.002, sigma_max=700.0,
    )  # fmt: skip
    stock.set_timesteps(12)
    torch.testing.assert_close(karras_sigmas(12), stock.sigmas, rtol=1e-5, atol=1e-6)


def test_training_and_sampling_feed_the_same_channels(job: Path, backbone: SvdBackbone, monkeypatch) -> None:
    config = load_config("tiny", stage="motion", overrides=OVERRIDES)
    store = open_store(job, config.backbone)
    item = TrainingItems(store, store.keys("train"), config).item("street_0", "parity", held_out=True)
    fed: list[torch.Tensor] = []
    clean = item.target_BCFHW

    def answer(sample: torch.Tensor, timestep: torch.Tensor, **_: object):
        fed.append(sample.clone())
        sigma = torch.exp(4 * timestep).view(-1, 1, 1, 1, 1)
        noisy = sample[:, :, :4].transpose(1, 2) * (sigma**2 + 1).sqrt()
        output = (clean - noisy / (sigma**2 + 1)) * -((sigma**2 + 1).sqrt()) / sigma
        return (output.transpose(1, 2),)

    monkeypatch.setattr(backbone.denoiser, "forward", answer)
    backbone.sample(
        item.inputs, noise_BCFHW=item.noise_BCFHW, empty_text=store.text(""),
        settings=SamplingSettings(steps=4, guidance=1.0),
    )  # fmt: skip
    sampled, fed = fed, []
    for sigma in karras_sigmas(4)[:-1]:
        loss = backbone.losses(item.inputs, clean, noise_BCFHW=item.noise_BCFHW, sigma_B=sigma[None])
        assert float(loss) < 1e-3
    for trained, drawn in zip(fed, sampled, strict=True):
        # What differs is rounding: the sampler starts from eps sigma_max, training adds the clean latents to it.
        torch.testing.assert_close(drawn, trained, rtol=0, atol=2e-2)


def test_both_stages_train_save_load_and_generate(job: Path, tmp_path: Path) -> None:
    adapters = {}
    for stage in ("motion", "appearance"):
        config = load_config("tiny", stage=stage, overrides=OVERRIDES)
        summary = train(config, data=job, out=tmp_path / stage, quiet=True)
        assert isinstance(summary, TrainSummary)
        assert summary.trainable == plan_run(config).trainable_parameters
        adapters[stage] = summary.adapter
    generator = ClipGenerator(load_backbone(backbone_config("tiny-svd")), **adapters)
    sample = FakeSample(key="street_0")
    image = sample.frames("rgb.mp4")[0]
    conditions = ClipConditions(image=image, caption="A road.", first_control=np.zeros_like(image))
    clips = [generator.sample(conditions, seed=3, settings=SamplingSettings(steps=2)) for _ in range(2)]
    assert clips[0].rgb is not None and clips[0].control is not None
    assert clips[0].rgb.shape == clips[0].control.shape == (5, 64, 96, 3)
    assert np.array_equal(clips[0].rgb, clips[1].rgb)  # type: ignore[arg-type]


def test_an_ltx_adapter_is_refused(tmp_path: Path, backbone: SvdBackbone) -> None:
    from training.adapters import adapter_bytes, attach_adapter
    from training.config import AdapterConfig
    from training.tiny import tiny_transformer

    transformer, config = tiny_transformer(), AdapterConfig(rank=2)
    attach_adapter(transformer, "motion", config)
    path = tmp_path / "ltx.safetensors"
    path.write_bytes(adapter_bytes(transformer, "motion", config, about={}))
    with pytest.raises(ModelError, match="not an adapter for SVD"):
        backbone.load_adapter(path, "motion")


def test_the_real_sizes_fit_and_the_recipe_is_stated() -> None:
    assert SVD_GEOMETRY.latent_shape(frames=25, height=512, width=768) == (4, 25, 64, 96)
    plan = plan_run(load_config("motion_svd"))
    assert plan.base_parameters == pytest.approx(1.5246e9, rel=1e-3)
    picture = load_config("motion_svd").backbone.picture
    assert (picture.frames, picture.fps) == (25, 12.0)

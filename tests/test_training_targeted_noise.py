"""Targeted noise: only where skeletons are, as strong as omega says, everything else bit-equal."""

from typing import Any

import numpy as np
import pytest
import torch
from training_fixtures import HEIGHT, WIDTH, FakeSample, one_thread, tiny_config, tiny_job  # noqa: F401

from labeling.errors import DataError
from labeling.skeleton_video import draw_skeletons
from training.backbone import LatentGeometry
from training.batches import TrainingItems
from training.clip_views import ClipViews
from training.config import PictureConfig
from training.draws import keyed_uniform
from training.latents import open_store
from training.targeted_noise import add_targeted_noise, latent_mask

GEOMETRY = LatentGeometry(channels=128, spatial=32, temporal=8)


def noised(omega: float, formula, *, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(128, 4, 8, 12, generator=generator)
    mask = torch.rand(4, 8, 12, generator=generator) < 0.3
    noise = torch.randn(latents.shape, generator=generator)
    return latents, mask, add_targeted_noise(latents, mask, omega=omega, noise_CFHW=noise, formula=formula)


@pytest.mark.parametrize("omega", [0.05, 0.1, 0.3])
def test_variance_on_lit_cells_is_omega(omega: float) -> None:
    latents, mask, result = noised(omega, "variance")
    added = (result - latents)[:, mask]
    assert float(added.var()) == pytest.approx(omega, rel=0.03)
    assert float(added.mean()) == pytest.approx(0, abs=0.01)


def test_blend_is_the_released_formula() -> None:
    latents, mask, result = noised(0.2, "blend")
    noise = torch.randn(0)
    generator = torch.Generator().manual_seed(0)
    torch.randn(latents.shape, generator=generator)
    torch.rand(mask.shape, generator=generator)
    noise = torch.randn(latents.shape, generator=generator)
    assert torch.equal(result[:, mask], (0.8 * latents + 0.2 * noise)[:, mask])


@pytest.mark.parametrize("formula", ["variance", "blend"])
def test_unlit_cells_keep_their_bits(formula) -> None:
    latents, mask, result = noised(0.3, formula)
    assert torch.equal(result[:, ~mask], latents[:, ~mask])
    assert not torch.equal(result[:, mask], latents[:, mask])


def test_an_all_black_video_is_unchanged() -> None:
    views = ClipViews(
        sample=FakeSample(key="a_0", empty=True), picture=PictureConfig(control_width=WIDTH, control_height=HEIGHT),
        indices=np.arange(9), label_width=WIDTH, label_height=HEIGHT,
    )  # fmt: skip
    mask = torch.from_numpy(views.skeleton_cells(GEOMETRY))
    latents = torch.randn(128, *mask.shape)
    assert not views.skeleton().any()
    assert torch.equal(add_targeted_noise(latents, mask, omega=0.3, noise_CFHW=torch.randn(latents.shape)), latents)


def test_mask_groups_frames_as_the_vae_does() -> None:
    lit = np.zeros((17, 2, 3), bool)
    lit[0, 0, 0] = lit[8, 0, 1] = lit[9, 1, 2] = True
    mask = latent_mask(lit, geometry=GEOMETRY)
    assert np.argwhere(mask).tolist() == [[0, 0, 0], [1, 0, 1], [2, 1, 2]]


def test_stored_mask_is_lit_exactly_where_a_pixel_is(tiny_job) -> None:  # noqa: F811
    config = tiny_config("appearance")
    store = open_store(tiny_job, config.backbone)
    for key in store.keys("train"):
        labels = FakeSample(key=key).keypoints()
        frames = [
            draw_skeletons([one], width=WIDTH, height=HEIGHT, label_width=WIDTH, label_height=HEIGHT) for one in labels
        ]
        lit: Any = np.stack(frames).any(axis=-1).reshape(9, HEIGHT // 32, 32, WIDTH // 32, 32).any(axis=(2, 4))
        assert np.array_equal(store.mask(key, "skeleton").numpy(), np.stack([lit[:1].any(0), lit[1:].any(0)]))


def test_a_mask_of_another_size_is_refused() -> None:
    with pytest.raises(DataError, match="does not fit"):
        add_targeted_noise(torch.zeros(8, 2, 2, 2), torch.ones(2, 2, 3), omega=0.1, noise_CFHW=torch.zeros(8, 2, 2, 2))


def test_training_draws_omega_per_sample_and_leaves_timestep_and_background_alone(tiny_job) -> None:  # noqa: F811
    """An appearance sample sees noise of variance omega ~ U(0, 0.3) on lit cells of the skeleton, nothing else."""
    config = tiny_config("appearance")
    store = open_store(tiny_job, config.backbone)
    items = TrainingItems(store, store.keys("train"), config)
    key = store.keys("train")[0]
    clean, mask = store.read(key, ["skeleton"])["skeleton"], store.mask(key, "skeleton")
    variances, omegas = [], []
    for step in range(300):
        (reference,) = items.item(key, "train", step, 0).inputs.references
        difference = reference.latents_BCFHW[0] - clean
        assert not difference[:, ~mask].any()
        variances.append(float(difference[:, mask].var()))
        omegas.append(0.3 * keyed_uniform(config.seed, "train", step, 0, key, "omega"))
    assert np.allclose(variances, omegas, rtol=0.25, atol=1e-4)
    quantiles = np.quantile(omegas, [0, 0.25, 0.5, 0.75, 1])
    assert np.allclose(quantiles, [0, 0.075, 0.15, 0.225, 0.3], atol=0.03)


def test_other_stages_and_held_out_samples_have_no_targeted_noise(tiny_job) -> None:  # noqa: F811
    config = tiny_config("appearance")
    store = open_store(tiny_job, config.backbone)
    key = store.keys("train")[0]
    item = TrainingItems(store, [key], config).item(key, "any", held_out=True)
    assert torch.equal(item.inputs.references[0].latents_BCFHW[0], store.read(key, ["skeleton"])["skeleton"])

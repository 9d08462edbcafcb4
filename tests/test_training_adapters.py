"""Adapters: diffusers' format with alpha, the released layout, two on one backbone, exact switching."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler, LTXPipeline
from safetensors.torch import load_file, save_file
from training_fixtures import one_thread  # noqa: F401

from labeling.errors import ModelError
from training.adapters import (
    DIFFUSERS_METADATA,
    activate_adapter,
    adapter_bytes,
    adapter_names,
    adapter_state,
    attach_adapter,
    load_adapter,
    read_adapter,
    trainable_count,
)
from training.config import AdapterConfig
from training.tiny import tiny_text, tiny_transformer, tiny_vae


def filled(transformer: torch.nn.Module, name: str, config: AdapterConfig, *, seed: int = 1) -> torch.nn.Module:
    """With an adapter whose both halves are random: a fresh one does nothing."""
    attach_adapter(transformer, name, config)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for key, parameter in transformer.named_parameters():
            if f".{name}." in key:
                parameter.copy_(0.2 * torch.randn(parameter.shape, generator=generator))
    return transformer


def answer(transformer: torch.nn.Module) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        return transformer(
            hidden_states=torch.randn(1, 12, 128, generator=generator), timestep=torch.full((1, 12), 500.0),
            encoder_hidden_states=torch.randn(1, 4, 32, generator=generator),
            encoder_attention_mask=torch.ones(1, 4), video_coords=torch.rand(1, 3, 12, generator=generator) * 100,
            return_dict=False,
        )[0]  # fmt: skip


def stock_pipeline() -> LTXPipeline:
    tokenizer, encoder = tiny_text()
    text: Any = encoder
    return LTXPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(), vae=tiny_vae(), text_encoder=text, tokenizer=tokenizer,
        transformer=tiny_transformer(),
    )  # fmt: skip


def written(path: Path, transformer: torch.nn.Module, name: str, config: AdapterConfig) -> Path:
    path.write_bytes(adapter_bytes(transformer, name, config, about={"stage": name}))
    return path


@pytest.mark.parametrize(
    "config", [AdapterConfig(rank=4), AdapterConfig(rank=4, alpha=16)], ids=["alpha=r", "alpha=4r"]
)
def test_stock_diffusers_pipeline_gives_the_same_output(tmp_path: Path, config: AdapterConfig) -> None:
    ours = filled(tiny_transformer(), "motion", config)
    written(tmp_path / "a.safetensors", ours, "motion", config)
    pipeline = stock_pipeline()
    bare = answer(pipeline.transformer)
    pipeline.load_lora_weights(str(tmp_path), weight_name="a.safetensors", adapter_name="motion")
    torch.testing.assert_close(answer(pipeline.transformer), answer(ours), rtol=0, atol=1e-6)
    assert float((answer(ours) - bare).abs().max()) > 0.01


def test_save_and_load_round_trip(tmp_path: Path) -> None:
    config = AdapterConfig(rank=3, alpha=7)
    ours = filled(tiny_transformer(), "motion", config)
    path = written(tmp_path / "a.safetensors", ours, "motion", config)
    other = tiny_transformer()
    file = load_adapter(other, path, "motion")
    assert (file.rank, file.alpha, file.about) == (3, 7.0, {"stage": "motion"})
    activate_adapter(other, "motion")
    assert torch.equal(answer(other), answer(ours))
    assert adapter_bytes(other, "motion", config, about={"stage": "motion"}) == path.read_bytes()


def test_two_adapters_switch_and_the_base_is_restored_to_the_bit(tmp_path: Path) -> None:
    base = tiny_transformer()
    before = answer(base)
    weights = {name: tensor.clone() for name, tensor in base.state_dict().items()}
    paths = {}
    for seed, name in enumerate(("motion", "appearance"), start=1):
        config = AdapterConfig(rank=2 * seed, alpha=4)
        paths[name] = written(tmp_path / name, filled(tiny_transformer(), name, config, seed=seed), name, config)
    alone = {}
    for name, path in paths.items():
        network = tiny_transformer()
        load_adapter(network, path, name)
        activate_adapter(network, name)
        alone[name] = answer(network)
        load_adapter(base, path, name)
    assert adapter_names(base) == ["motion", "appearance"]
    for name in ("motion", "appearance", None, "motion", None):
        activate_adapter(base, name)
        assert torch.equal(answer(base), before if name is None else alone[name]), name
    now = {key.replace(".base_layer", ""): value for key, value in base.state_dict().items()}
    assert all(torch.equal(now[key], value) for key, value in weights.items())


RENAMINGS = {
    "diffusers, as released": lambda key: f"transformer.{key}",
    "comfyui": lambda key: f"diffusion_model.{key}",
    "peft": lambda key: f"base_model.model.{key}",
    "peft with the adapter's name": lambda key: f"base_model.model.{key}".replace(".weight", ".default.weight"),
    "bare": lambda key: key,
    "up and down": lambda key: f"transformer.{key}".replace("lora_A", "lora_down").replace("lora_B", "lora_up"),
}


@pytest.mark.parametrize("layout", RENAMINGS)
def test_released_and_foreign_key_layouts_load(tmp_path: Path, layout: str) -> None:
    """The released ``LTX_2B_r512_Lora_*.safetensors`` hold LoRA pairs without alpha: alpha equals the rank then."""
    config = AdapterConfig(rank=4)
    ours = filled(tiny_transformer(), "x", config)
    lora, _ = adapter_state(ours, "x")
    path = tmp_path / "LTX_2B_r512_Lora_Pose_Forecaster.safetensors"
    save_file({RENAMINGS[layout](key): tensor for key, tensor in lora.items()}, path)
    other = tiny_transformer()
    file = load_adapter(other, path, "motion")
    assert (file.alpha, file.about) == (4.0, {})
    activate_adapter(other, "motion")
    assert torch.equal(answer(other), answer(ours))


def test_alpha_tensors_are_honoured(tmp_path: Path) -> None:
    config = AdapterConfig(rank=4, alpha=2)
    ours = filled(tiny_transformer(), "x", config)
    lora, _ = adapter_state(ours, "x")
    modules = {key.split(".lora_")[0] for key in lora}
    lora |= {f"{module}.alpha": torch.tensor(2.0) for module in modules}
    save_file({f"transformer.{key}": tensor for key, tensor in lora.items()}, tmp_path / "a.safetensors")
    assert read_adapter(tmp_path / "a.safetensors").alpha == 2
    (tmp_path / "a.safetensors").rename(tmp_path / "adapter.safetensors")
    assert read_adapter(tmp_path).alpha == 2, "the folder that training wrote stands for the adapter in it"


@pytest.mark.parametrize("settings", [{"use_rslora": True}, {"alpha_pattern": {"to_q": 8}}, None], ids=str)
def test_adapters_of_another_scale_are_refused(tmp_path: Path, settings: dict[str, Any] | None) -> None:
    """Loaded as a plain LoRA, such an adapter would act too weakly or too strongly, and nothing would say so."""
    lora, _ = adapter_state(filled(tiny_transformer(), "x", AdapterConfig(rank=4, alpha=4)), "x")
    tensors = {f"transformer.{key}": tensor for key, tensor in lora.items()}
    told = {"r": 4, "lora_alpha": 4, "use_rslora": False, "rank_pattern": {}, "alpha_pattern": {}, **(settings or {})}
    metadata = {DIFFUSERS_METADATA: json.dumps({f"transformer.{key}": value for key, value in told.items()})}
    if settings is None:
        modules = sorted({key.split(".lora_")[0] for key in lora})
        tensors |= {f"transformer.{one}.alpha": torch.tensor(float(place)) for place, one in enumerate(modules, 1)}
        metadata = {}
    save_file(tensors, tmp_path / "a.safetensors", metadata=metadata)
    with pytest.raises(ModelError, match=next(iter(settings), "alphas") if settings else "alphas"):
        load_adapter(tiny_transformer(), tmp_path / "a.safetensors", "motion")


@pytest.mark.parametrize("value", [float("nan"), float("inf")], ids=str)
def test_an_adapter_whose_numbers_are_not_finite_is_refused(tmp_path: Path, value: float) -> None:
    """It would make black videos, and nothing would say so."""
    config = AdapterConfig(rank=4)
    path = written(tmp_path / "a.safetensors", filled(tiny_transformer(), "x", config), "x", config)
    tensors = load_file(path)
    spoilt = sorted(tensors)[3]
    tensors[spoilt][0, 0] = value
    save_file(tensors, path)
    with pytest.raises(ModelError, match=rf"{path}.*1 of its {len(tensors)} tensors.*{spoilt}; take an earlier"):
        load_adapter(tiny_transformer(), path, "motion")


def test_only_the_adapter_is_trainable_and_in_float32() -> None:
    transformer = tiny_transformer()
    torch.nn.Module.to(transformer, torch.bfloat16)
    parameters = attach_adapter(transformer, "motion", AdapterConfig(rank=4))
    named = {name: one for name, one in transformer.named_parameters() if one.requires_grad}
    assert {".lora_A.motion." in name or ".lora_B.motion." in name for name in named} == {True}
    assert {one.dtype for one in named.values()} == {torch.float32}
    assert {one.dtype for name, one in transformer.named_parameters() if name not in named} == {torch.bfloat16}
    # Two blocks; twice (q, k, v, out) of 64 -> 64, and the feed-forward 64 <-> 256.
    assert trainable_count(parameters) == 2 * 4 * (8 * 128 + 2 * 320)


def test_a_fresh_adapter_changes_nothing() -> None:
    transformer = tiny_transformer()
    before = answer(transformer)
    attach_adapter(transformer, "motion", AdapterConfig(rank=4))
    assert torch.equal(answer(transformer), before)


def broken_files(folder: Path) -> dict[str, Path]:
    config = AdapterConfig(rank=4)
    good = written(folder / "good.safetensors", filled(tiny_transformer(), "x", config), "x", config)
    tensors = load_file(good)
    files = {"missing": folder / "nothing.safetensors", "html": folder / "html", "cut": folder / "cut"}
    files["html"].write_text("<html>404</html>")
    files["cut"].write_bytes(good.read_bytes()[:-100])
    for name, changed in {
        "deeper": {key.replace("blocks.1", "blocks.9"): value for key, value in tensors.items()},
        "wider": {
            key: torch.cat([value, value], dim=1) if "lora_A" in key else value for key, value in tensors.items()
        },
        "half": {key: value for key, value in tensors.items() if "blocks.0.attn1.to_q.lora_B" not in key},
        "no lora": {"weight": torch.zeros(3)},
    }.items():
        files[name] = folder / f"{name}.safetensors"
        save_file({key: value.contiguous() for key, value in changed.items()}, files[name])
    return files


@pytest.mark.parametrize("kind", ["missing", "html", "cut", "deeper", "wider", "half", "no lora"])
def test_files_that_do_not_fit_are_refused(tmp_path: Path, kind: str) -> None:
    with pytest.raises(ModelError, match=r"adapter|LoRA|backbone"):
        load_adapter(tiny_transformer(), broken_files(tmp_path)[kind], "motion")


def test_unknown_adapter_names_and_targets_are_refused() -> None:
    with pytest.raises(ModelError, match="not loaded"):
        activate_adapter(tiny_transformer(), "motion")
    with pytest.raises(ModelError, match="does not fit"):
        attach_adapter(tiny_transformer(), "motion", AdapterConfig(rank=4, targets=("nothing_like_it",)))


def test_metadata_names_rank_alpha_and_targets(tmp_path: Path) -> None:
    from safetensors import safe_open

    config = AdapterConfig(rank=4, alpha=8)
    path = written(tmp_path / "a.safetensors", filled(tiny_transformer(), "motion", config), "motion", config)
    with safe_open(path, framework="pt") as file:
        metadata = json.loads(file.metadata()["lora_adapter_metadata"])
    assert (metadata["transformer.r"], metadata["transformer.lora_alpha"]) == (4, 8.0)
    assert len(metadata["transformer.target_modules"]) == 2 * 10

"""Latents: fingerprinted, resumable, by part, from labels and not from decoded skeletons."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from training_fixtures import (  # noqa: F401
    HEIGHT,
    PICTURE,
    WIDTH,
    FakeSample,
    fake_datasets,
    one_thread,
    tiny_config,
    tiny_job,
)

from labeling.errors import ConfigError, DataError, ModelError
from labeling.skeleton_video import draw_skeletons
from training import latents as module
from training.backbones import load_backbone
from training.config import BACKBONES, backbone_config
from training.latent_store import LatentStore
from training.latents import cache_latents, check_store, open_store
from training.sampling_inputs import LabelledFrame, check_aspect


@pytest.fixture(scope="module")
def backbone():
    return load_backbone(backbone_config("tiny", picture=PICTURE))


def cache(folder: Path, backbone: Any, **settings: Any):
    return cache_latents(
        folder, **{"backbone_name": "tiny", "backbone": backbone, "datasets": fake_datasets(), **settings}
    )


def contents(folder: Path) -> dict[str, bytes]:
    """Everything but the logs, whose lines may come in another order."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*.safetensors"))}


def test_store_holds_every_view_at_the_right_shape(tiny_job) -> None:  # noqa: F811
    store = open_store(tiny_job, tiny_config("motion").backbone)
    assert (store.keys("val"), len(store.keys("train"))) == (["other_0", "other_48"], 4)
    tensors = store.read("street_0", ["rgb", "image", "skeleton", "ego", "objects"])
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    video = (128, 2, HEIGHT // 32, WIDTH // 32)
    assert shapes == {name: video if name != "image" else (128, 1, 2, 3) for name in tensors}
    assert not torch.equal(tensors["rgb"], tensors["skeleton"])


def test_skeletons_are_rasterised_from_labels(tiny_job, backbone) -> None:  # noqa: F811
    """``FakeSample.frames`` would give RGB for any suffix: the cached skeleton must be the drawn one."""
    store = open_store(tiny_job, backbone.config)
    drawn = np.stack([
        draw_skeletons([one], width=WIDTH, height=HEIGHT, label_width=WIDTH, label_height=HEIGHT)
        for one in FakeSample(key="street_0").keypoints()
    ])  # fmt: skip
    assert torch.equal(store.read("street_0", ["skeleton"])["skeleton"], backbone.encode_video(drawn))


def test_first_latent_frame_is_the_first_frame_alone(backbone) -> None:
    """The VAE is causal, so what sampling encodes (one frame) is what training saw (the first of many)."""
    frames = FakeSample(key="street_0").frames("rgb.mp4")
    torch.testing.assert_close(backbone.encode_video(frames)[:, :1], backbone.encode_video(frames[:1]))


def test_other_controls_are_decoded_by_name(tmp_path: Path, backbone) -> None:
    cache(tmp_path, backbone, controls=["segmentation"], datasets={"train": [FakeSample(key="a_0")]})
    store = LatentStore(tmp_path / "latents" / "tiny")
    assert store.read("a_0", ["segmentation"])["segmentation"].shape == (128, 2, 2, 3)
    assert bool(store.mask("a_0", "segmentation").all())


def test_parts_make_what_one_run_makes(tmp_path: Path, backbone, tiny_job) -> None:  # noqa: F811
    made = [cache(tmp_path, backbone, part=(index, 3)).made for index in range(3)]
    assert sum(made) == 6 and max(made) < 6
    assert contents(tmp_path) == contents(tiny_job)


def test_a_stopped_run_goes_on_and_ends_the_same(tmp_path: Path, backbone, tiny_job) -> None:  # noqa: F811
    def stop_at_three(done: int, _: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cache(tmp_path, backbone, progress=stop_at_three)
    log = next((tmp_path / "latents" / "tiny").glob("clips-*.jsonl"))
    log.write_text(log.read_text() + '{"key": "torn')
    summary = cache(tmp_path, backbone)
    assert (summary.made, summary.kept) == (3, 3)
    assert contents(tmp_path) == contents(tiny_job)
    assert cache(tmp_path, backbone).made == 0


def clips(*keys: str) -> list[FakeSample]:
    return [FakeSample(key=key) for key in keys]


def test_clips_that_left_the_shards_are_retired_and_come_back_without_work(tmp_path: Path, backbone) -> None:
    every = {"train": clips("a_0", "b_0", "c_0"), "val": clips("d_0")}
    cache(tmp_path, backbone, datasets=every)
    fewer = {"train": clips("a_0"), "val": clips("d_0")}
    # Of two hosts, either may come first, and both say the same of clips that are not theirs.
    summaries = [cache(tmp_path, backbone, datasets=fewer, part=(index, 2)) for index in (1, 0)]
    assert [(one.made, one.retired) for one in summaries] == [(0, 2), (0, 0)]
    store = LatentStore(tmp_path / "latents" / "tiny")
    assert (store.keys("train"), store.keys("val")) == (["a_0"], ["d_0"])
    with pytest.raises(DataError, match="no latents of clip b_0"):
        store.record("b_0")
    assert cache(tmp_path, backbone, datasets=every).made == 0
    assert LatentStore(store.folder).keys("train") == ["a_0", "b_0", "c_0"]


def test_the_newest_split_holds_whatever_the_number_of_parts(tmp_path: Path, backbone) -> None:
    old = {"train": clips("a_0", "b_0", "c_0"), "val": clips("d_0")}
    for index in (0, 1):
        cache(tmp_path, backbone, datasets=old, part=(index, 2))
    new = {"train": clips("b_0", "c_0", "d_0"), "val": clips("a_0")}
    folder = tmp_path / "latents" / "tiny"
    for _ in range(2):
        assert cache(tmp_path, backbone, datasets=new).made == 0
        store = LatentStore(folder)
        assert (store.keys("train"), store.keys("val")) == (["b_0", "c_0", "d_0"], ["a_0"])
    lines = [line for log in folder.glob("clips-*.jsonl") for line in log.read_text().splitlines()]
    assert len(lines) == 6, "a run that changes nothing writes nothing"


def test_a_damaged_clip_and_a_changed_source_are_made_anew(tmp_path: Path, backbone, monkeypatch) -> None:
    few = {"datasets": fake_datasets(1, 1)}
    cache(tmp_path, backbone, **few)
    store = LatentStore(tmp_path / "latents" / "tiny")
    (store.folder / store.record("street_0").file).write_bytes(b"short")
    assert cache(tmp_path, backbone, **few).made == 1
    monkeypatch.setattr(module, "_encoded_digest", lambda sample, controls: f"new {sample.key}")
    assert cache(tmp_path, backbone, **few).made == 2


@dataclass
class PackedSample(FakeSample):
    """A fake clip that names the bytes of its members, as clips of shards do."""

    changed: str = ""
    """The member that is other than it was."""

    @property
    def members(self) -> dict[str, Any]:
        names = ("rgb.mp4", "skeleton.mp4", "ego.mp4", "labels.parquet", "cam_to_world.npy", "txt", "json")
        return {name: SimpleNamespace(sha256=f"{self.key} {name} {name == self.changed}") for name in names}

    @property
    def caption(self) -> str:
        return "A road, told anew." if self.changed == "txt" else super().caption


@pytest.mark.parametrize(
    ("changed", "made"),
    [("txt", 0), ("json", 0), ("skeleton.mp4", 0), ("rgb.mp4", 1), ("labels.parquet", 1), ("cam_to_world.npy", 1)],
)
def test_latents_are_made_anew_where_what_they_are_made_of_has_changed(
    tmp_path: Path, backbone, changed: str, made: int
) -> None:
    def digests() -> list[str]:
        store = LatentStore(tmp_path / "latents" / "tiny")
        assert torch.equal(
            store.text(store.record("a_0").caption).tokens_LD,
            backbone.encode_text([store.record("a_0").caption])[0].tokens_LD,
        )
        return [store.data_digest("train"), store.record("a_0").caption]

    before = {"train": [PackedSample(key="a_0"), PackedSample(key="b_0")]}
    after = {"train": [PackedSample(key="a_0", changed=changed), PackedSample(key="b_0")]}
    cache(tmp_path, backbone, datasets=before)
    data, caption = digests()
    assert cache(tmp_path, backbone, datasets=after).made == made
    assert digests()[0] != data, "a run on the clips as they were is refused"
    assert (digests()[1] != caption) == (changed == "txt")
    assert cache(tmp_path, backbone, datasets=after).made == 0
    assert cache(tmp_path, backbone, datasets=before).made == made
    assert digests() == [data, caption]


def test_latents_of_an_older_version_stay_while_nothing_has_changed(tmp_path: Path, backbone) -> None:
    folder = tmp_path / "latents" / "tiny"

    def as_older_versions_wrote() -> None:
        (log,) = folder.glob("clips-*.jsonl")
        records = [json.loads(line) for line in log.read_text().splitlines()]
        lines = [{name: value for name, value in record.items() if name != "encoded"} for record in records]
        log.write_text("".join(f"{json.dumps(line)}\n" for line in lines))

    told = {"train": [PackedSample(key="a_0")]}
    cache(tmp_path, backbone, datasets=told)
    data = LatentStore(folder).data_digest("train")
    as_older_versions_wrote()
    assert cache(tmp_path, backbone, datasets=told).made == 0
    assert LatentStore(folder).data_digest("train") == data
    again = {"train": [PackedSample(key="a_0", changed="txt")]}
    assert cache(tmp_path, backbone, datasets=again).made == 0, "what they are made of is known by now"
    as_older_versions_wrote()
    assert cache(tmp_path, backbone, datasets=told).made == 1, "nothing tells what had changed"


def test_latents_that_a_kill_left_without_their_record_are_made_anew(tmp_path: Path, backbone, monkeypatch) -> None:
    before, after = ({"train": [PackedSample(key="a_0", changed=name)]} for name in ("", "rgb.mp4"))
    cache(tmp_path, backbone, datasets=before)
    write = module._write_clip

    def killed(*arguments: Any) -> None:
        write(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_write_clip", killed)
    with pytest.raises(KeyboardInterrupt):
        cache(tmp_path, backbone, datasets=after)
    monkeypatch.undo()
    assert cache(tmp_path, backbone, datasets=before).made == 1


def test_captions_are_encoded_once_each(tmp_path: Path, backbone, monkeypatch) -> None:
    seen: list[str] = []
    encode = backbone.encode_text
    monkeypatch.setattr(backbone, "encode_text", lambda captions: seen.extend(captions) or encode(captions))
    summary = cache(tmp_path, backbone)
    captions = {sample.caption for split in fake_datasets().values() for sample in split}
    assert sorted(seen) == sorted({"", *captions})
    assert summary.captions == len(captions)
    store = LatentStore(tmp_path / "latents" / "tiny")
    for caption in captions:
        assert torch.equal(store.text(caption).tokens_LD, encode([caption])[0].tokens_LD)


CHANGES: dict[str, Callable[[Any], dict[str, Any]]] = {
    "vae": lambda _: {"backbone": load_backbone(backbone_config("tiny", picture=PICTURE, seed=1))},
    "picture": lambda _: {
        "backbone": load_backbone(backbone_config("tiny", picture=PICTURE | {"rgb_width": 192, "rgb_height": 128}))
    },
    "controls": lambda backbone: {"backbone": backbone, "controls": ["hdmap"]},
    "storage": lambda backbone: {"backbone": backbone, "object_variants": 2},
}


@pytest.mark.parametrize("changed", CHANGES)
def test_a_stale_cache_is_refused_with_both_fingerprints(tmp_path: Path, backbone, changed: str) -> None:
    few = {"datasets": fake_datasets(1, 1)}
    held = cache(tmp_path, backbone, **few)
    settings = CHANGES[changed](backbone) | few
    with pytest.raises(DataError, match=f"stale.*changed: .*{changed}") as caught:
        cache(tmp_path, **{"backbone": backbone, **settings})
    assert held.fingerprint[:16] in str(caught.value)
    fresh = cache(tmp_path, **{"backbone": backbone, **settings}, refresh=True)
    assert fresh.made == 2 and fresh.fingerprint[:16] in str(caught.value)


def test_the_trainer_refuses_another_vae_or_size(tiny_job) -> None:  # noqa: F811
    config = tiny_config("motion").backbone
    store = open_store(tiny_job, config)
    check_store(store, config, vae_fingerprint=load_backbone(config).fingerprint_vae())
    with pytest.raises(DataError, match="changed: vae"):
        check_store(store, config, vae_fingerprint="0" * 64)
    with pytest.raises(DataError, match="changed: picture"):
        check_store(store, backbone_config("tiny"))


@pytest.mark.parametrize(
    ("picture", "frames", "message"),
    [
        (PICTURE, 10, "8k\\+1"),
        (PICTURE | {"rgb_width": 100}, 9, "multiples of 32"),
        (PICTURE | {"frames": 17}, 9, "17"),
    ],
    ids=["10 frames", "100 pixels", "clip too short"],
)
def test_sizes_are_checked_before_anything_is_spent(tmp_path: Path, picture, frames: int, message: str) -> None:
    datasets = {"train": [FakeSample(key="a_0", frames_count=frames)]}
    with pytest.raises(ConfigError, match=message):
        cache_latents(tmp_path, backbone_name="tiny", picture=picture, datasets=datasets)
    assert not list(tmp_path.rglob("*.safetensors"))


@pytest.mark.parametrize("side", ["control", "rgb"])
def test_sizes_of_another_aspect_than_the_clips_are_refused(tmp_path: Path, side: str) -> None:
    """Training would squeeze such a picture, sampling would crop it."""
    wide = backbone_config("tiny", picture=PICTURE | {f"{side}_width": 128})
    with pytest.raises(ConfigError, match=r"96x64 \(aspect 1.500\), the backbone's 128x64 \(2.000\)"):
        cache(tmp_path, load_backbone(wide))
    assert not list(tmp_path.iterdir())
    drawn = LabelledFrame(labels=[], width=WIDTH, height=HEIGHT)
    with pytest.raises(ConfigError, match="squeezed in training and cropped in sampling"):
        drawn.drawn(wide.picture)


@pytest.mark.parametrize("name", BACKBONES)
def test_presets_have_the_aspect_of_the_jobs_pictures(name: str) -> None:
    check_aspect(backbone_config(name).picture, width=1056, height=704)


def test_what_is_absent_is_named(tmp_path: Path, tiny_job) -> None:  # noqa: F811
    with pytest.raises(DataError, match="animatic cache"):
        LatentStore(tmp_path)
    store = open_store(tiny_job, tiny_config("motion").backbone)
    with pytest.raises(DataError, match="hdmap"):
        store.read("street_0", ["hdmap"])
    with pytest.raises(DataError, match="no latents of clip"):
        store.record("nowhere_0")
    with pytest.raises(DataError, match="no embedding of caption"):
        store.text("never seen")
    copy = tmp_path / "copy"
    shutil.copytree(store.folder, copy)
    (copy / store.record("street_0").file).write_bytes(b"\0" * 40)
    with pytest.raises(DataError, match="cannot be read"):
        LatentStore(copy).read("street_0", ["rgb"])


def test_the_vae_with_timestep_conditioning_decodes_the_same_for_a_seed() -> None:
    from training.ltx import LtxBackbone
    from training.tiny import tiny_ltx_makers, tiny_vae

    config = backbone_config("tiny", picture=PICTURE)
    makers = tiny_ltx_makers(config) | {"vae": lambda: tiny_vae(timestep_conditioning=True)}
    backbone = LtxBackbone(config, device="cpu", makers=makers)
    latents = backbone.encode_video(FakeSample(key="a_0").frames("rgb.mp4"))
    videos = [backbone.decode_video(latents, seed=seed) for seed in (1, 1, 2)]
    assert videos[0].shape == (9, HEIGHT, WIDTH, 3)
    assert np.array_equal(videos[0], videos[1])
    assert not np.array_equal(videos[0], videos[2])


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("nonsense", "'nonsense' is not known; give cpu, cuda"),
        ("cuda:99", "'cuda:99' cannot be used on this machine.*give cpu"),
        ("meta", "'meta' cannot be used"),
    ],
)
def test_a_device_that_is_not_there_is_refused(device: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_backbone(backbone_config("tiny", picture=PICTURE), device=device)


def write_ltx(folder: Path) -> None:
    """A tiny LTX repository, laid out as diffusers lays out the real one."""
    from training.tiny import tiny_text, tiny_transformer, tiny_vae

    tokenizer, encoder = tiny_text()
    parts: dict[str, Any] = {
        "transformer": tiny_transformer(), "vae": tiny_vae(), "tokenizer": tokenizer, "text_encoder": encoder,
    }  # fmt: skip
    for name, part in parts.items():
        part.save_pretrained(folder / name)


@pytest.fixture
def empty_hub(tmp_path: Path, monkeypatch) -> Path:
    """A hub's cache with nothing in it; whoever asks the network fails the test."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))

    def refuse(*_: object, **__: object) -> None:
        pytest.fail("the network was asked")

    monkeypatch.setattr("socket.getaddrinfo", refuse)
    return tmp_path / "hub"


def test_weights_load_from_a_folder_and_from_the_hubs_cache(tmp_path: Path, empty_hub: Path) -> None:
    told = {"dtype": "float32", "picture": PICTURE}
    tiny = load_backbone(backbone_config("tiny")).fingerprint()
    write_ltx(tmp_path / "LTX")
    ours = load_backbone(backbone_config("ltx-2b", **told, weights=str(tmp_path / "LTX")))
    assert ours.fingerprint() == tiny
    denoiser: Any = ours.denoiser
    assert denoiser.config["num_layers"] == 2
    repository = empty_hub / "models--Lightricks--LTX-Video"
    shutil.copytree(tmp_path / "LTX", repository / "snapshots" / "abc")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("abc")
    assert load_backbone(backbone_config("ltx-2b", **told)).fingerprint() == tiny


LTX_PARTS = re.escape("--include 'vae/*' --include 'transformer/*' --include 'tokenizer/*' --include 'text_encoder/*'")


@pytest.mark.parametrize(
    ("preset", "use", "message"),
    [
        ("ltx-2b", "vae", r"'Lightricks/LTX-Video' .*nothing is downloaded.*/hub lacks vae/config.json, vae/\*"),
        ("ltx-2b", "vae", rf"`hf download Lightricks/LTX-Video {LTX_PARTS}`.*`weights`.* YAML"),
        ("ltx-2b", "text", rf"`hf download Lightricks/LTX-Video {LTX_PARTS}`"),
        ("svd", "vae", r"`hf download \S+ --include 'vae/\*' --include 'unet/\*' --include 'image_encoder/\*'`"),
        ("ltx-13b", "denoiser", r"'Lightricks/LTX-Video-0.9.7-dev' .*lacks transformer/config.json"),
        ("ltx-2b", "text", r"lacks tokenizer/tokenizer_config.json, text_encoder/config.json"),
        ("svd", "text", r"'google/t5-v1_1-large' .*lacks tokenizer_config.json, config.json.*v1_1-large`"),
        ("svd", "image", r"'stabilityai/.*lacks image_encoder/config.json"),
    ],
)
def test_absent_weights_are_named_and_never_downloaded(empty_hub: Path, preset: str, use: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        load_backbone(backbone_config(preset), parts=[use])


def test_a_folder_that_lacks_weights_or_holds_others_is_named(tmp_path: Path, empty_hub: Path) -> None:
    def load(weights: Path, part: str) -> None:
        load_backbone(backbone_config("ltx-2b", weights=str(weights)), parts=[part])

    write_ltx(tmp_path / "LTX")
    (tmp_path / "LTX" / "vae" / "diffusion_pytorch_model.safetensors").unlink()
    with pytest.raises(ModelError, match=r"LTX lacks vae/\*.safetensors; copy them there"):
        load(tmp_path / "LTX", "vae")
    with pytest.raises(ModelError, match=r"none' are no folder and no file; name one that holds vae/config.json"):
        load(tmp_path / "none", "vae")
    (tmp_path / "LTX" / "transformer" / "diffusion_pytorch_model.safetensors").write_bytes(b"short")
    with pytest.raises(ModelError, match="LTXVideoTransformer3DModel could not be loaded from"):
        load(tmp_path / "LTX", "denoiser")


def test_a_single_file_in_lightricks_own_names_loads(tmp_path: Path) -> None:
    """One file with the transformer under ``model.diffusion_model.``, as the released checkpoints are laid out."""
    from safetensors.torch import save_file

    from training.tiny import tiny_transformer

    names = {"proj_in": "patchify_proj", "time_embed": "adaln_single", "norm_q": "q_norm", "norm_k": "k_norm"}
    tensors = {}
    for key, tensor in tiny_transformer().state_dict().items():
        for ours, theirs in names.items():
            key = key.replace(ours, theirs)
        tensors[f"model.diffusion_model.{key}"] = tensor
    save_file(tensors, tmp_path / "ltx.safetensors")
    tiny_transformer().save_config(tmp_path / "configs" / "transformer")
    told = {
        "kind": "ltx", "size": "2b", "weights": str(tmp_path / "ltx.safetensors"), "dtype": "float32",
        "weights_config": str(tmp_path / "configs"),
    }  # fmt: skip
    backbone = load_backbone(backbone_config("ltx-2b", **told))
    wanted, found = tiny_transformer().state_dict(), backbone.denoiser.state_dict()
    assert wanted.keys() == found.keys()
    assert all(torch.equal(wanted[key], found[key]) for key in wanted)
    with pytest.raises(ModelError, match=r"set backbone\.text_weights"):
        backbone.encode_text(["A road."])

"""Making latents: each clip's videos through the VAE, each caption through the text encoder, once.

Skeletons are rasterised afresh from keypoints and object and ego videos from tracks and trajectories, since a decoded
4:2:0 video has lost their colours; only RGB (and controls that have no labels) are decoded. The mask for targeted noise
comes from the same keypoints. A clip is done when its line is in the part's log; a killed job goes on from there. Where
its caption or its choice alone has changed, it gets another line, and its latents stay. Clips that left the shards are
retired: every part says so in its own log, so that no host waits for another.
"""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dataset.layout import LATENTS
from dataset.receipts import atomic_write, digest, hashed_share, make_folder, storage_errors
from labeling.camera import Intrinsics
from labeling.errors import ConfigError, DataError
from labeling.skeleton_video import DEFAULT_STYLE
from training.backbone import Backbone
from training.backbones import load_backbone
from training.claims import sweep
from training.clip_views import ClipSample, ClipViews, frame_indices
from training.config import BackboneConfig, PictureConfig, backbone_config
from training.latent_store import (
    IMAGE_EMBEDDING,
    MANIFEST,
    CacheManifest,
    ClipRecord,
    LatentStore,
    check_fresh,
    read_manifest,
    read_records,
    text_path,
)
from training.sampling_inputs import check_aspect
from training.stages import EGO, IMAGE, OBJECTS, RGB
from training.weights import tensor_bytes

CODE_VERSION = 1
"""Raised whenever the same clip would give other latents."""

Progress = Callable[[int, int], None]
"""Called with clips done and clips in all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheSummary:
    """What a caching run did."""

    folder: Path
    made: int
    """Clips encoded now."""
    kept: int
    """Clips that were there already."""
    retired: int
    """Clips of the store that are in the shards no longer, and are not offered from now on."""
    captions: int
    """Distinct captions of this part."""
    fingerprint: str
    bytes: int
    """Of all clips of this part."""


def cache_latents(
    job_dir: Path | str,
    *,
    backbone_name: str,
    part: tuple[int, int] = (0, 1),
    progress: Progress | None = None,
    controls: Sequence[str] = (),
    object_variants: int = 1,
    picture: Mapping[str, Any] | None = None,
    device: str = "cpu",
    refresh: bool = False,
    out: Path | None = None,
    backbone: Backbone | None = None,
    datasets: Mapping[str, Any] | None = None,
) -> CacheSummary:
    """Cache the latents of a job's clips under ``latents/<backbone>``.

    Args:
        job_dir: the job, or a folder of shards.
        backbone_name: a preset of ``training.config.BACKBONES``, or a YAML file.
        part: (i, n): only clips whose key falls to part i of n.
        progress: called after every clip.
        controls: names of further control videos in the shards (``segmentation``, ``hdmap``).
        object_variants: object videos per clip.
        picture: replaces fields of the backbone's ``picture``.
        device: where the networks run.
        refresh: throw away what was made with other settings.
        out: another folder than ``latents/<backbone>`` in the job.
        backbone: already loaded.
        datasets: by split; read from the job's shards if not given.

    Raises:
        ConfigError: frame counts or sizes that the backbone does not take, or sizes of another aspect than the clips'.
        DataError: a stale cache (both fingerprints are named), no clips.
        StorageError: no space left, or the folder cannot be written to.
    """
    config = (
        backbone.config if backbone else backbone_config(backbone_name, **({"picture": picture} if picture else {}))
    )
    datasets = datasets or _shard_datasets(Path(job_dir))
    folder = out or Path(job_dir) / LATENTS / config.name
    samples = [(split, sample) for split, dataset in datasets.items() for sample in dataset]
    if not samples:
        raise DataError(f"{job_dir} has no clips to cache; `animatic status` says what was dropped and why")
    backbone = backbone or load_backbone(config, device=device)
    clip_frames = len(samples[0][1].cam_to_world)
    manifest = plan_manifest(backbone, clip_frames=clip_frames, controls=controls, object_variants=object_variants)
    width, height = _picture_size(samples[0][1])
    check_aspect(config.picture, width=width, height=height)
    make_folder(folder)
    with storage_errors(folder):
        _open_store(folder, manifest, refresh=refresh)
        mine = [(split, one) for split, one in samples if int(hashed_share("part", one.key) * part[1]) == part[0]]
        return _cache_part(
            folder, mine, backbone, manifest, present={one.key for _, one in samples}, part=part, controls=controls,
            object_variants=object_variants, progress=progress,
        )  # fmt: skip


def _shard_datasets(job: Path) -> dict[str, Any]:
    from dataset.loader import ShardDataset

    return {split: ShardDataset(job, split) for split in ("train", "val")}


def plan_manifest(
    backbone: Backbone, *, clip_frames: int, controls: Sequence[str] = (), object_variants: int = 1
) -> CacheManifest:
    """What a cache of this backbone depends on; checks sizes before anything is spent.

    Raises:
        ConfigError: frame counts or sizes that the backbone does not take.
    """
    config, picture = backbone.config, backbone.config.picture
    frames = len(frame_indices(clip_frames, picture))
    for width, height in ((picture.control_width, picture.control_height), (picture.rgb_width, picture.rgb_height)):
        backbone.geometry.latent_shape(frames=frames, height=height, width=width)
    parts = backbone.fingerprint() | {
        "picture": digest(picture.model_dump() | {"frames": frames}),
        "style": digest(asdict(DEFAULT_STYLE)),
        "code": str(CODE_VERSION),
        "storage": f"{config.latent_dtype}, {config.text_tokens} text tokens, {object_variants} object variants",
        "controls": ",".join(sorted(controls)),
    }
    return CacheManifest(parts=parts, frames=frames, fps=picture.fps, backbone=config.model_dump(mode="json"))


def _open_store(folder: Path, manifest: CacheManifest, *, refresh: bool) -> None:
    held = read_manifest(folder)
    if held is not None and held.parts != manifest.parts:
        if not refresh:
            check_fresh(folder, held, manifest.parts)
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder.rglob(".*.tmp"))
    if held is None or held.parts != manifest.parts:
        atomic_write(folder / MANIFEST, manifest.to_json().encode())


def _cache_part(
    folder: Path, samples: Sequence[tuple[str, Any]], backbone: Backbone, manifest: CacheManifest, *,
    present: Set[str], part: tuple[int, int], controls: Sequence[str], object_variants: int, progress: Progress | None,
) -> CacheSummary:  # fmt: skip
    held = {record.key: record for record in read_records(folder)}
    log = folder / f"clips-{part[0]}of{part[1]}.jsonl"
    _cut_torn_line(log)
    gone = [record for key, record in held.items() if key not in present and not record.retired]
    for record in gone:
        _append_line(log, replace(record, retired=True, turn=record.turn + 1).line())
    made, total_bytes, captions = 0, 0, {""}
    _cache_texts(folder, [""], backbone)
    for done, (split, sample) in enumerate(samples, start=1):
        told = _told(sample, split, controls)
        known = held.get(sample.key)
        if known is not None and _is_whole(folder, known, told):
            # Its latents are the same in either split, under another caption, and when it comes back.
            record = replace(known, **told)
        else:
            if known is not None:
                # A kill must not leave the new latents under a record that tells what the old ones were made of.
                known = replace(known, source="", encoded="", retired=True, turn=known.turn + 1)
                _append_line(log, known.line())
            tensors = encode_clip(sample, backbone, manifest, controls=controls, object_variants=object_variants)
            file, size = _write_clip(folder, tensors, sample)
            record = ClipRecord(
                key=sample.key, file=file, size=size, object_variants=object_variants, turn=known.turn if known else 0,
                **told,
            )  # fmt: skip
            made += 1
        _cache_texts(folder, [record.caption], backbone)
        if record != known:
            _append_line(log, replace(record, turn=record.turn + 1).line())
        captions.add(record.caption)
        total_bytes += record.size
        if progress:
            progress(done, len(samples))
    return CacheSummary(
        folder=folder, made=made, kept=len(samples) - made, retired=len(gone), captions=len(captions) - 1,
        bytes=total_bytes, fingerprint=manifest.fingerprint,
    )  # fmt: skip


def encode_clip(
    sample: ClipSample, backbone: Backbone, manifest: CacheManifest, *, controls: Sequence[str] = (),
    object_variants: int = 1,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """All latents of one clip by name, in the storage type, and the skeleton's mask as uint8.

    Raises:
        ConfigError: the clip's picture has another aspect than the backbone's.
    """
    picture = backbone.config.picture.model_copy(update={"frames": manifest.frames})
    camera, (width, height) = sample.meta.get("intrinsics"), _picture_size(sample)
    check_aspect(picture, width=width, height=height)
    views = ClipViews(
        sample=sample, picture=picture, indices=frame_indices(len(sample.cam_to_world), picture),
        label_width=width, label_height=height,
        intrinsics=Intrinsics(**camera) if camera else None,
    )  # fmt: skip
    dtype = getattr(torch, backbone.config.latent_dtype)
    rgb = views.rgb()
    tensors = {
        name: backbone.encode_video(frames).to(dtype) for name, frames in _videos(views, rgb, controls, object_variants)
    }
    tensors["mask_skeleton"] = torch.from_numpy(views.skeleton_cells(backbone.geometry).astype(np.uint8))
    embedding = backbone.encode_image(rgb[0])
    if embedding is not None:
        tensors[IMAGE_EMBEDDING] = embedding.to(dtype)
    for name in controls:
        # Every cell counts where there are no labels to say which are lit.
        tensors[f"mask_{name}"] = torch.ones(tensors[name].shape[1:], dtype=torch.uint8)
    return {name: tensor.contiguous() for name, tensor in tensors.items()}


def _picture_size(sample: ClipSample) -> tuple[int, int]:
    """Width and height of a clip's picture, which its labels are in."""
    size = sample.meta.get("picture", sample.meta)
    if not {"width", "height"} <= size.keys():
        raise DataError(f"{sample.key}: its record does not say how large its picture is; pack it again")
    return int(size["width"]), int(size["height"])


def _videos(
    views: ClipViews, rgb: np.ndarray, controls: Sequence[str], object_variants: int
) -> Iterator[tuple[str, np.ndarray]]:
    yield RGB, rgb
    yield IMAGE, views.image(rgb)
    yield "skeleton", views.skeleton()
    yield EGO, views.ego()
    for variant in range(object_variants):
        yield f"{OBJECTS}_{variant}", views.objects(variant)
    for name in controls:
        yield name, views.control(name)


def _told(sample: Any, split: str, controls: Sequence[str]) -> dict[str, Any]:
    """What a clip's record tells of the clip as it is now."""
    return {
        "split": split, "caption": sample.caption, "retired": False, "source": _source_digest(sample),
        "encoded": _encoded_digest(sample, controls),
    }  # fmt: skip


def _source_digest(sample: Any) -> str:
    members = getattr(sample, "members", None)
    return digest({suffix: member.sha256 for suffix, member in members.items()} if members else sample.key)


def _encoded_digest(sample: Any, controls: Sequence[str]) -> str:
    """Over what ``encode_clip`` reads of a clip, and no more: its caption and the rest of its record may change."""
    members = getattr(sample, "members", None)
    if not members:
        return digest(sample.key)
    names = ["rgb.mp4", "labels.parquet", "cam_to_world.npy", *(f"{name}.mp4" for name in sorted(controls))]
    read = {name: members[name].sha256 for name in names if name in members}
    return digest([read, sample.meta.get("intrinsics"), _picture_size(sample)])


def _is_whole(folder: Path, record: ClipRecord, told: Mapping[str, Any]) -> bool:
    """Whether a clip's latents are there, and made of what they would be made of now."""
    path = folder / record.file
    # Records of older versions tell only what the whole clip was.
    name = "encoded" if record.encoded else "source"
    return getattr(record, name) == told[name] and path.is_file() and path.stat().st_size == record.size


def _write_clip(folder: Path, tensors: Mapping[str, torch.Tensor], sample: ClipSample) -> tuple[str, int]:
    """The clip's file, relative to the store's folder, and its bytes."""
    path = folder / "clips" / sample.key.rpartition("_")[0] / f"{sample.key}.safetensors"
    data = tensor_bytes(tensors, metadata={"key": sample.key})
    atomic_write(path, data)
    return str(path.relative_to(folder)), len(data)


def _cache_texts(folder: Path, captions: Sequence[str], backbone: Backbone) -> None:
    for caption in captions:
        path = text_path(folder, caption)
        if not path.is_file():
            tokens = backbone.encode_text([caption])[0].tokens_LD.to(getattr(torch, backbone.config.latent_dtype))
            atomic_write(path, tensor_bytes({"tokens": tokens.contiguous()}, metadata={"caption": caption}))


def _append_line(log: Path, line: str) -> None:
    with log.open("a", encoding="utf-8") as file:
        file.write(line)
        file.flush()
        os.fsync(file.fileno())


def _cut_torn_line(log: Path) -> None:
    if log.is_file():
        data = log.read_bytes()
        if data and not data.endswith(b"\n"):
            atomic_write(log, data[: data.rfind(b"\n") + 1])


def open_store(job_dir: Path, config: BackboneConfig) -> LatentStore:
    """The store of a backbone in a job (or the store's own folder).

    Raises:
        DataError: nothing was cached.
    """
    own = Path(job_dir)
    return LatentStore(own if (own / MANIFEST).is_file() else own / LATENTS / config.name)


def check_store(store: LatentStore, config: BackboneConfig, *, vae_fingerprint: str | None = None) -> None:
    """Refuse latents that do not fit what a run needs.

    Raises:
        DataError: stale; both fingerprints and what changed are named.
    """
    frames = config.picture.frames or store.manifest.frames
    parts = {"picture": digest(config.picture.model_dump() | {"frames": frames}), "code": str(CODE_VERSION)}
    parts["style"] = digest(asdict(DEFAULT_STYLE))
    if vae_fingerprint is not None:
        parts["vae"] = vae_fingerprint
    check_fresh(store.folder, store.manifest, parts)


def manifest_picture(store: LatentStore) -> PictureConfig:
    """The sizes that a store was made at, its frame count filled in.

    Raises:
        ConfigError: a manifest of another version.
    """
    try:
        return PictureConfig.model_validate(store.manifest.backbone["picture"] | {"frames": store.manifest.frames})
    except (KeyError, ValueError) as error:
        raise ConfigError(f"{store.folder / MANIFEST} names no picture that this version knows; cache again") from error

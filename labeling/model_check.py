"""Does a network want what its card says? It is run as the card says, and as the card's likely mistakes would.

Wrong channel order, wrong range, a missing or needless normalisation and outputs without their sigmoid raise no error:
they only make a network see less. On pictures that show what the network looks for, the right way sees most. Channel
order shows least: on a grey road YOLOX-nano sees as much either way, and such a doubt is said, not decided.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from labeling.detection import decode_yolox, letterbox
from labeling.errors import ModelError
from labeling.fields import FieldDecoder, padded_input
from labeling.keypoints import crop_input, decode_simcc, plan_crop
from labeling.model_cards import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    CifcafCard,
    ModelCard,
    SimccCard,
    YoloxCard,
)
from labeling.onnx_model import DEFAULT_PROVIDERS, OnnxModel, check_frame, network_input

Verdict = Literal["fits", "another fits better", "unclear", "fails"]
"""``fails``: fed as its card says, it gives nothing that can be used."""

_RANGES = {
    "0 to 255": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    "0 to 1": ((0.0, 0.0, 0.0), (255.0, 255.0, 255.0)),
    "ImageNet mean and std": (IMAGENET_MEAN, IMAGENET_STD),
}
_CLEAR_SHARE, _WRONG_SHARE = 0.9, 0.5
"""The card's way fits if every other sees less than 0.9 of what it sees; it is wrong if it sees less than half of what
another sees; between the two the pictures do not tell."""
_TOLERANCE = 1e-3
"""How far a sigmoid's output may lie outside 0 to 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VariantResult:
    """What the network saw when it was fed in one way."""

    name: str
    """Such as ``BGR, 0 to 255``, and ``, sigmoid added`` where its confidences are logits."""
    is_card: bool
    """The way that the card says."""
    objects: int
    """Detections, objects, or points present."""
    evidence: float
    """Sum of their scores."""
    logits: bool = False
    """Its confidences lay outside 0 to 1, and were put through a sigmoid."""
    note: str = ""
    """Why it could not be run."""
    failed: bool = False
    """The network is at fault for that, not the pictures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CardCheck:
    """The whole comparison."""

    card: str
    providers: tuple[str, ...]
    variants: tuple[VariantResult, ...]
    """Most evidence first."""
    verdict: Verdict
    advice: str
    """One sentence."""


def check_card(
    card: ModelCard,
    path: Path,
    images: Sequence[np.ndarray] = (),
    *,
    boxes_xyxy: Sequence[np.ndarray] | None = None,
    providers: Sequence[str] = DEFAULT_PROVIDERS,
    threads: int = 1,
) -> CardCheck:
    """Run ``card``'s network on pictures in every likely way, and tell which fits.

    Args:
        card: to be checked.
        path: its weights.
        images: (H, W, 3) uint8 RGB each, that show what the network looks for; without any only the contract and the
            range of the confidences can be told.
        boxes_xyxy: (n, 4) around the objects of each picture, for a ``simcc`` head; the whole picture by default.
        providers: as ``OnnxModel``.
        threads: as ``OnnxModel``.

    Raises:
        ModelError: the contract itself is broken (file, hash, shapes), or an image is no RGB picture.
    """
    model = OnnxModel(card, path, providers=providers, threads=threads)
    pictures = list(images) or [_noise(card)]
    for picture in pictures:
        check_frame(picture)
    if boxes_xyxy is None:
        boxes_xyxy = [np.array([[0, 0, one.shape[1], one.shape[0]]], np.float32) for one in pictures]
    scenes = list(zip(pictures, boxes_xyxy, strict=True))
    variants = [_try(model, variant, name, scenes, is_card=variant == card) for name, variant in _variants(card)]
    variants.sort(key=lambda result: (-result.evidence, not result.is_card, result.name))
    verdict, advice = _judge(variants, seen=bool(images), batch_fault=_batch_fault(model))
    return CardCheck(
        card=card.name, providers=model.providers, variants=tuple(variants), verdict=verdict, advice=advice
    )


class _NothingToSeeError(ModelError):
    """A head was given no box to look at."""


Scene = tuple[np.ndarray, np.ndarray]
"""A picture and its boxes, (n, 4)."""


def _variants(card: ModelCard) -> list[tuple[str, ModelCard]]:
    """The card's own way, then every other channel order and range, each once."""
    ways = [(order, name, *values) for order in ("rgb", "bgr") for name, values in _RANGES.items()]
    own = next((name for name, values in _RANGES.items() if values == (card.mean, card.std)), "the card's mean and std")
    if own not in _RANGES:
        ways += [(order, own, card.mean, card.std) for order in ("rgb", "bgr")]
    return [
        (f"{order.upper()}, {name}", card.model_copy(update={"channel_order": order, "mean": mean, "std": std}))
        for order, name, mean, std in ways
    ]


def _try(model: OnnxModel, variant: ModelCard, name: str, scenes: Sequence[Scene], *, is_card: bool) -> VariantResult:
    look = {"yolox": _look_yolox, "simcc": _look_simcc, "cifcaf": _look_cifcaf}[variant.kind]
    try:
        looks = [look(model, variant, picture, boxes) for picture, boxes in scenes]
    except ModelError as error:
        failed = not isinstance(error, _NothingToSeeError)
        return VariantResult(name=name, is_card=is_card, objects=0, evidence=0.0, note=str(error), failed=failed)
    logits = any(added for _, added in looks)
    return VariantResult(
        name=name + (", sigmoid added" if logits else ""), is_card=is_card and not logits, logits=logits,
        objects=sum(len(scores) for scores, _ in looks), evidence=float(sum(scores.sum() for scores, _ in looks)),
    )  # fmt: skip


def _look_yolox(model: OnnxModel, card: ModelCard, picture: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, bool]:
    assert isinstance(card, YoloxCard)
    planes, ratio = letterbox(picture, card)
    output = model.run(planes[None])[0][0].copy()
    output[:, 4:], added = _as_confidence(output[:, 4:])
    found = decode_yolox(output, card, ratio=ratio, width=picture.shape[1], height=picture.shape[0])
    return found.distinct().scores, added


def _look_simcc(model: OnnxModel, card: ModelCard, picture: np.ndarray, boxes: np.ndarray) -> tuple[np.ndarray, bool]:
    assert isinstance(card, SimccCard)
    crops = [crop for box in boxes if (crop := plan_crop(box, card)) is not None]
    if not crops:
        raise _NothingToSeeError(f"none of the {len(boxes)} boxes has an area; give left, top, right, bottom in pixels")
    simcc_x, simcc_y = model.run(np.stack([crop_input(picture, crop, card) for crop in crops]))
    scores = decode_simcc(simcc_x, simcc_y, split=card.simcc_split)[..., 2]
    return np.minimum(scores[scores > 0], 1), False


def _look_cifcaf(model: OnnxModel, card: ModelCard, picture: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, bool]:
    assert isinstance(card, CifcafCard)
    fields = [output[0].copy() for output in model.run(padded_input(picture, card)[0][None])]
    added = False
    for field in fields:
        field[:, 1], logits = _as_confidence(field[:, 1])
        added |= logits
    scores: list[float] = []
    for n, head in enumerate(card.heads):
        decoder = FieldDecoder(head, stride=card.stride)
        scores += [score for _, score in decoder.decode(fields[2 * n], fields[2 * n + 1])]
    return np.array(scores), added


def _as_confidence(values: np.ndarray) -> tuple[np.ndarray, bool]:
    """Confidences, 0 to 1: as they are, or through a sigmoid where they are logits; and which."""
    if values.min() >= -_TOLERANCE and values.max() <= 1 + _TOLERANCE:
        return values, False
    return 1 / (1 + np.exp(-np.clip(values, -60, 60))), True


def _batch_fault(model: OnnxModel) -> str:
    """Why the network does not take two pictures at once; empty where it does."""
    planes = network_input(_noise(model.card), model.card)
    try:
        model.run(np.stack([planes, planes[:, ::-1]]))
    except ModelError as error:
        return str(error)
    return ""


def _judge(variants: Sequence[VariantResult], *, seen: bool, batch_fault: str) -> tuple[Verdict, str]:
    best, own = variants[0], next((result for result in variants if result.is_card), None)
    if own is not None and own.failed:
        return "fails", f"fed as its card says ({own.name}), {own.note}"
    if batch_fault:
        return "fails", f"given two pictures at once, {batch_fault}"
    if any(result.logits for result in variants):
        return "another fits better", (
            f"its confidences lie outside 0 to 1: they are logits, best fed as {best.name}; "
            "add a sigmoid to the graph's confidences and check again"
        )
    if not seen:
        return "unclear", "file, hash, shapes and ranges hold; give pictures that show cars or people for the rest"
    if best.evidence <= 0:
        return "unclear", "nothing is seen in any way: give pictures that show what the network looks for"
    assert own is not None, "only logits take the card's own way from it"
    rivals = [result for result in variants if not result.is_card]
    if rivals[0].evidence < _CLEAR_SHARE * own.evidence:
        return "fits", f"{own.name}, as the card says"
    if own.evidence < _WRONG_SHARE * best.evidence:
        good = [result.name for result in rivals if result.evidence >= _WRONG_SHARE * best.evidence]
        share = own.evidence / best.evidence
        return (
            "another fits better",
            f"the card's {own.name} sees {share:.0%} of what {' or '.join(good)} sees: change it",
        )
    return "unclear", (
        f"{rivals[0].name} sees {rivals[0].evidence / own.evidence:.0%} of what {own.name} (the card) sees, which "
        "decides nothing: give pictures of stronger colours, or trust what the network's authors say"
    )


def _noise(card: ModelCard) -> np.ndarray:
    shape = (card.input_height, card.input_width, 3)
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)

"""Losses of the street models, scalars averaged over a batch. Shape suffixes as in ``street_networks``."""

import torch
from torch import Tensor
from torch.nn import functional

from training.street_second_look import SecondScores, decode_boxes, pair_overlap

_MATCH_IOU = 0.4
"""Of a candidate with an object that it may be the one of: somewhat more than the judge asks for."""
_INSIDE = 0.5
"""Share of a candidate within an object that is not judged, from which on nothing is said of it."""
MINOR = 0.3
"""Weight of candidates that no judge asks about, found or not."""


def detector_loss(
    rows: Tensor, classes: Tensor, boxes_xyxy: Tensor, weights: Tensor, cells: Tensor, strides: Tensor
) -> Tensor:
    """Overlap, objectness and class losses of a grid detector (Ge et al. 2021, with fixed assignment).

    Args:
        rows: (N, A, 5 + C) as ``StreetDetector`` gives them.
        classes: (N, A) int64 as in ``GridTargets``.
        boxes_xyxy: (N, A, 4) input pixels.
        weights: (N, A) as in ``GridTargets``.
        cells: (A, 2) column and row of each cell.
        strides: (A,) pixels per cell.
    """
    positive = classes >= 0
    count = positive.sum().clamp(min=1)
    sample, cell = positive.nonzero(as_tuple=True)
    picked, truth = rows[sample, cell], boxes_xyxy[sample, cell]
    overlap, generalised = _overlaps(decode_boxes(picked, cells[cell], strides[cell]), truth)
    objectness = torch.zeros_like(rows[..., 4])
    # The overlap ranks an object's cells for suppression. Its root does so too, and is fairer to small objects, whose
    # boxes are never exact.
    objectness[sample, cell] = overlap.detach().clamp(min=0.25).sqrt()
    entropy = functional.binary_cross_entropy_with_logits(rows[..., 4], objectness, reduction="none")
    entropy = (entropy * weights).sum() / count
    naming = _naming(picked[:, 5:], classes[sample, cell]).sum() / count
    uncounted = classes < -1
    # A slice of a car at the picture's edge need not be found, but is no person either.
    hinted = (_naming(rows[..., 5:], (-2 - classes).clamp(min=0)) * uncounted).sum() / uncounted.sum().clamp(min=1)
    return 3 * (1 - generalised).sum() / count + entropy + 0.5 * (naming + hinted)


def _naming(logits: Tensor, classes: Tensor) -> Tensor:
    """(...,) cross-entropy of class logits (..., C)."""
    names = functional.one_hot(classes, logits.shape[-1]).to(logits)
    return functional.binary_cross_entropy_with_logits(logits, names, reduction="none").sum(dim=-1)


def _overlaps(boxes: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Intersection over union of pairs, and its generalised form (Rezatofighi et al. 2019)."""
    inner = torch.minimum(boxes[:, 2:], truth[:, 2:]) - torch.maximum(boxes[:, :2], truth[:, :2])
    outer = torch.maximum(boxes[:, 2:], truth[:, 2:]) - torch.minimum(boxes[:, :2], truth[:, :2])
    shared = inner.clamp(min=0).prod(dim=1)
    union = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1) + (truth[:, 2:] - truth[:, :2]).prod(dim=1) - shared
    overlap = shared / union.clamp(min=1e-6)
    hull = outer.prod(dim=1).clamp(min=1e-6)
    return overlap, overlap - (hull - union) / hull


def simcc_loss(
    outputs: tuple[Tensor, Tensor, Tensor],
    responses: tuple[Tensor, Tensor],
    weights: Tensor,
    visible: Tensor,
    tolerance_bins: Tensor,
    *,
    hidden_weight: float = 1.0,
) -> Tensor:
    """Cross-entropy along each axis, and of the score: the probability that a point is seen *and* found.

    Args:
        outputs: logits (N, K, 2 W), (N, K, 2 H) and (N, K) as ``SimccNetwork`` gives them.
        responses: (N, K, 2 W) and (N, K, 2 H), rows that sum to 1.
        weights: (N, K) of the points' places: 1 visible, less where hidden, 0 where unknown.
        visible: (N, K) 0 or 1.
        tolerance_bins: (N,) distance within which a point counts as found.
        hidden_weight: of hidden points in the score's loss: above 1, a point in doubt scores lower than its chances.
    """
    total = weights.sum().clamp(min=1)
    loss = outputs[2].new_zeros(())
    off = []
    for logits, response in zip(outputs[:2], responses, strict=True):
        loss = loss - ((response * logits.log_softmax(dim=2)).sum(dim=2) * weights).sum() / total
        off.append(logits.detach().argmax(dim=2) - response.argmax(dim=2))
    found = torch.hypot(off[0].float(), off[1].float()) <= tolerance_bins[:, None]
    doubt = torch.where(visible > 0, 1.0, hidden_weight)
    score = functional.binary_cross_entropy_with_logits(outputs[2], visible * found, weight=doubt)
    return loss + 2 * score


def field_loss(field: Tensor, places: Tensor, values: Tensor) -> Tensor:
    """Cross-entropy of the confidences, smooth L1 of offsets and scales where there is something.

    Args:
        field: cif (N, K, 4, h, w) or caf (N, E, 7, h, w) as ``FieldNetwork`` gives it.
        places: (P, 4) int64: picture, field, row, column of the cells that are not empty.
        values: (P, 3 or 6) as in ``FieldVotes``.
    """
    count, width = max(1, len(places)), values.shape[1]
    picture, row, y, x = places.T
    confidence = field[:, :, 0].float()
    target = torch.zeros_like(confidence)
    target[picture, row, y, x] = 1
    # Not focal: the decoder adds confidences up, and focal loss leaves them timid.
    entropy = functional.binary_cross_entropy_with_logits(confidence, target, reduction="sum")
    parts = torch.arange(1, 1 + width, device=field.device)
    picked = field[picture[:, None], row[:, None], parts, y[:, None], x[:, None]].float()
    offsets = 2 * width // 3
    places_off = functional.smooth_l1_loss(picked[:, :offsets], values[:, :offsets], beta=0.1, reduction="sum")
    scales_off = functional.l1_loss(picked[:, offsets:], values[:, offsets:], reduction="sum")
    return 3 * entropy / count + (places_off + 0.2 * scales_off) / (width // 3 * count)


def second_look_loss(
    look: SecondScores, boxes_xyxy: Tensor, classes: Tensor, importance: Tensor, *, size: tuple[int, int], low_px: float
) -> Tensor:
    """Cross-entropy of the second look's scores, per picture.

    Of each object the candidate that scores highest is right, and every other is wrong (Hosang et al. 2017).

    Args:
        look: of N pictures.
        boxes_xyxy: (N, G, 4) objects, input pixels, inside the picture.
        classes: (N, G) int64; -1 where there is no object.
        importance: (N, G) weight of each object: 1 where it is judged, less where it need not be found.
        size: width and height of the pictures.
        low_px: height from which on what is found is judged.
    """
    limits = boxes_xyxy.new_tensor((*size, *size))
    boxes = torch.minimum(look.candidates.boxes_xyxy.clamp(min=0), limits)
    overlap, inside = pair_overlap(boxes, boxes_xyxy)
    minor = torch.where(boxes[..., 3] - boxes[..., 1] < low_px, MINOR, 1.0)
    total = look.logits.new_zeros(())
    for index in range(look.logits.shape[2]):
        logits, mine = look.logits[..., index], classes == index
        match = match_candidates(logits.detach(), torch.where(mine[:, None], overlap, 0.0))
        on_unjudged = ((inside > _INSIDE) & (mine & (importance < 1))[:, None]).any(dim=2)
        weights = torch.where(on_unjudged, 0.0, minor)
        weights = torch.where(match >= 0, importance.gather(1, match.clamp(min=0)), weights)
        wanted = (match >= 0).to(logits)
        entropy = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
        total = total + (entropy * weights).sum()
    return total / len(boxes)


def match_candidates(scores: Tensor, overlap: Tensor) -> Tensor:
    """(N, M) object of each candidate or -1: the best candidate chooses first, each object is chosen once.

    Args:
        scores: (N, M).
        overlap: (N, M, G) of candidates with objects; only ``_MATCH_IOU`` and more matches.
    """
    match = torch.full(scores.shape, -1, device=scores.device)
    free = torch.ones_like(overlap[:, 0])
    for chooser in scores.argsort(dim=1, descending=True).T:
        row = chooser[:, None, None].expand(-1, 1, overlap.shape[2])
        best, at = (overlap.gather(1, row).squeeze(1) * free).max(dim=1)
        hit = (best >= _MATCH_IOU)[:, None]
        match.scatter_(1, chooser[:, None], torch.where(hit, at[:, None], -1))
        free.scatter_(1, at[:, None], torch.where(hit, 0.0, free.gather(1, at[:, None])))
    return match

"""The detector's score thresholds, chosen on streets that neither train nor judge: as many exact counts as can be."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from labeling.detection import Detections, Detector
from labeling.model_cards import YoloxCard, read_card, write_card
from training.street_plans import VALIDATION_SEED, judging_frames
from training.street_pool import ObjectTruth
from training.street_scores import is_judged, match_boxes

_CANDIDATES = tuple(float(value) for value in np.round(np.arange(0.2, 0.76, 0.05), 2))


def choose_thresholds(card_path: Path, *, streets: int = 30, frames: int = 6) -> YoloxCard:
    """Write the thresholds that give most frames exact counts of each class into a detector's card.

    Args:
        card_path: a street detector's card beside its weights.
        streets: how many choose.
        frames: of each.

    Returns:
        The card as written.
    """
    card = read_card(card_path)
    assert isinstance(card, YoloxCard)
    eager = card.model_copy(update={"score_threshold": _CANDIDATES[0], "score_thresholds": {}})
    detector = Detector(eager, card_path.with_name(card.file))
    exact: dict[str, list[list[bool]]] = {name: [] for name in card.class_names}
    for rgb, truths in judging_frames(VALIDATION_SEED, streets, frames):
        found = detector.detect([rgb])[0]
        for name, rows in exact.items():
            seen = found.select(found.classes == name)
            mine = [truth for truth in truths if truth.category == card.categories[name]]
            rows.append([counts_exactly(seen, mine, threshold) for threshold in _CANDIDATES])
    best = {name: best_threshold(np.array(rows).mean(axis=0)) for name, rows in exact.items()}
    chosen = card.model_copy(update={"score_threshold": min(best.values()), "score_thresholds": best})
    write_card(chosen, card_path)
    return chosen


def counts_exactly(found: Detections, truths: Sequence[ObjectTruth], threshold: float) -> bool:
    """Whether the detections above a score are all the objects that are judged, and no phantom."""
    partner, phantoms = match_boxes(found.boxes_xyxy[found.scores > threshold], truths)
    missed = any(at < 0 and is_judged(truth) for at, truth in zip(partner, truths, strict=True))
    return not missed and not len(phantoms)


def best_threshold(shares: np.ndarray) -> float:
    """Of ``_CANDIDATES`` the one around which the share of exact counts is highest: a lone peak is luck.

    Args:
        shares: (len(_CANDIDATES),) 0 to 1.
    """
    smooth = np.convolve(np.pad(shares, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
    return _CANDIDATES[int(smooth.argmax())]

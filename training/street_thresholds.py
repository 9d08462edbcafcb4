"""Thresholds of the street models, chosen on streets that neither train nor judge: as many exact counts as can be."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from dataset.conditions import Condition, apply_condition
from labeling.detection import Detections, Detector
from labeling.fields import FieldModel
from labeling.labels import Keypoints
from labeling.model_cards import CifcafCard, YoloxCard, read_card, write_card
from training.street_pool import ObjectTruth
from training.street_scores import Tally, is_judged, judge_car_fields, judge_lanes, match_boxes

BOX_SCORES = tuple(float(value) for value in np.round(np.arange(0.1, 0.76, 0.05), 2))
"""Of boxes, to choose from."""
SURE_SCORES = tuple(float(value) for value in np.round(np.arange(0.1, 0.96, 0.01), 2))
"""Of boxes, from which a track may begin, to choose from."""
OBJECT_SCORES = tuple(float(value) for value in np.round(np.arange(0.16, 0.45, 0.03), 2))
"""Of bottom-up objects, to choose from."""
_LUCK = 0.005
_BAD_LIGHT: tuple[Condition, ...] = ("dusk", "night", "rain", "glare")
"""In which sure scores are chosen, since scores mean less there."""
_FEW_PHANTOMS = 0.005
"""Per frame, of all classes together: what a track may begin with. One phantom that is believed is shown for as long as
it lasts."""
JudgedFrame = tuple[np.ndarray, tuple[ObjectTruth, ...]]
"""(H, W, 3) uint8 RGB, and what is true in it."""


def choose_thresholds(folder: Path, names: Sequence[str], frames: Iterable[JudgedFrame]) -> None:
    """Write the thresholds that give most frames exact counts into the cards that have any.

    Args:
        folder: of the cards and their weights.
        names: of the cards.
        frames: that choose; gone through once, so that they may be rendered meanwhile.
    """
    choosers: list[BoxScoreChooser | ObjectScoreChooser] = []
    for name in names:
        card = read_card(folder / f"{name}.toml")
        if isinstance(card, YoloxCard):
            choosers.append(BoxScoreChooser(card, folder))
        elif isinstance(card, CifcafCard):
            choosers.append(ObjectScoreChooser(card, folder))
    if not choosers:
        return
    for rgb, truths in frames:
        for chooser in choosers:
            chooser.add(rgb, truths)
    for chooser in choosers:
        card = chooser.chosen()
        write_card(card, folder / f"{card.name}.toml")


class BoxScoreChooser:
    """The best threshold of each class, by its own class's counts, and one sure score.

    Sure is what few phantoms reach in bad light: each frame is looked at again in one of ``_BAD_LIGHT``, in turn.
    """

    def __init__(self, card: YoloxCard, folder: Path) -> None:
        self._card = card
        eager = card.model_copy(update={"score_threshold": BOX_SCORES[0], "score_thresholds": {}})
        self._detector = Detector(eager, folder / card.file)
        self._exact: dict[str, list[np.ndarray]] = {name: [] for name in card.class_names}
        self._phantoms = np.zeros(len(SURE_SCORES))
        self._frames = 0

    def add(self, rgb: np.ndarray, truths: Sequence[ObjectTruth]) -> None:
        """Look at one frame."""
        harm = _BAD_LIGHT[self._frames % len(_BAD_LIGHT)]
        harmed_rgb = apply_condition(rgb, harm, seed=self._frames, frame=self._frames)
        clear, harmed = self._detector.detect([rgb, harmed_rgb])
        for name, exact in self._exact.items():
            mine = [truth for truth in truths if truth.category == self._card.categories[name]]
            missed, extra = judge_counts(clear.select(clear.classes == name), mine, BOX_SCORES)
            exact.append(missed + extra == 0)
            self._phantoms += judge_counts(harmed.select(harmed.classes == name), mine, SURE_SCORES)[1]
        self._frames += 1

    def chosen(self) -> YoloxCard:
        """The card with the scores that the frames so far ask for."""
        best = {name: best_threshold(np.mean(rows, axis=0), BOX_SCORES) for name, rows in self._exact.items()}
        sure = sure_threshold(self._phantoms / self._frames, SURE_SCORES)
        return self._card.model_copy(
            update={
                "score_threshold": min(best.values()), "score_thresholds": best,
                "sure_scores": {name: max(score, sure) for name, score in best.items()},
            }
        )  # fmt: skip


class ObjectScoreChooser:
    """The best threshold of each schema's bottom-up objects."""

    def __init__(self, card: CifcafCard, folder: Path) -> None:
        self._card = card
        eager = [head.model_copy(update={"instance_threshold": OBJECT_SCORES[0]}) for head in card.heads]
        self._model = FieldModel(card.model_copy(update={"heads": tuple(eager)}), folder / card.file)
        self._tallies = [[Tally() for _ in OBJECT_SCORES] for _ in card.heads]

    def add(self, rgb: np.ndarray, truths: tuple[ObjectTruth, ...]) -> None:
        """Look at one frame."""
        found = self._model.estimate([rgb])[0]
        for head, mine in zip(self._card.heads, self._tallies, strict=True):
            judge = _FIELD_JUDGES[head.schema_name][1]
            objects = [one for one in found if one.schema == head.schema_name]
            for threshold, tally in zip(OBJECT_SCORES, mine, strict=True):
                judge([one for one in objects if one.score >= threshold], truths, tally)

    def chosen(self) -> CifcafCard:
        """The card with the scores that the frames so far ask for."""
        heads = []
        for head, mine in zip(self._card.heads, self._tallies, strict=True):
            shares = np.array([tally.figures()[_FIELD_JUDGES[head.schema_name][0]] for tally in mine])
            heads.append(head.model_copy(update={"instance_threshold": best_threshold(shares, OBJECT_SCORES)}))
        return self._card.model_copy(update={"heads": tuple(heads)})


def _judge_lanes(found: Sequence[Keypoints], truths: tuple[ObjectTruth, ...], tally: Tally) -> None:
    judge_lanes([item.points for item in found], tuple(one for one in truths if one.category == "lane"), tally)


_FIELD_JUDGES: dict[str, tuple[str, Callable[[Sequence[Keypoints], tuple[ObjectTruth, ...], Tally], None]]] = {
    "lane24": ("lane_count_exact", _judge_lanes),
    "car24": ("fields_car_count_exact", judge_car_fields),
}


def judge_counts(
    found: Detections, truths: Sequence[ObjectTruth], thresholds: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) how many objects that are judged the detections above each of n scores miss, and (n,) how many phantoms are
    among them; detections come best first."""
    # So are matches made: what scores more than a threshold is matched as if the rest were not there.
    partner, phantoms = match_boxes(found.boxes_xyxy, truths)
    judged = np.array([is_judged(truth) for truth in truths], bool)
    scores = np.append(found.scores, -np.inf)
    least = np.array(thresholds, np.float32)[:, None]
    return (scores[partner[judged]] <= least).sum(axis=1), (scores[phantoms] > least).sum(axis=1)


def sure_threshold(phantoms_per_frame: np.ndarray, candidates: Sequence[float]) -> float:
    """The lowest candidate above which phantoms are few; the highest where they never are.

    Args:
        phantoms_per_frame: (n,) one per candidate.
        candidates: n values, rising.
    """
    few = np.flatnonzero(phantoms_per_frame <= _FEW_PHANTOMS)
    return candidates[int(few[0])] if len(few) else candidates[-1]


def best_threshold(shares: np.ndarray, candidates: Sequence[float]) -> float:
    """The lowest candidate around which the share of exact counts is as good as highest.

    A lone peak is luck, and so is a point or two among some hundred frames: what is found more is worth more.

    Args:
        shares: (n,) 0 to 1, one per candidate.
        candidates: n values, rising.
    """
    smooth = np.convolve(np.pad(shares, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
    return candidates[int(np.flatnonzero(smooth >= smooth.max() - _LUCK)[0])]

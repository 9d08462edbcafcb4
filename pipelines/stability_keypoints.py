"""``animatic stability keypoints``: where keypoints and tracks fail, on the street with exact truth.

Dusk, night, rain, glare, blur, compression, boards in front of cars, small cars, people who cross, a cut, a frozen
second, an empty road; and whether scores can be believed. Every condition against the same clips undisturbed.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from dataset.conditions import Condition
from dataset.street import Scenario, Street, StreetConfig
from labeling.carrying import box_diagonal
from labeling.encoding import EncoderSettings
from labeling.extraction import Effort
from labeling.labels import Keypoints
from pipelines.keypoint_clips import HELD_OUT_SEED, KeypointClip, street_frames
from pipelines.keypoint_errors import MatchedFrame, match_frames, phantom_frames, point_score, recall, track_spans
from pipelines.keypoint_harm import (
    Board,
    behind_board,
    board_targets,
    frozen,
    in_condition,
    label_clip,
    spliced,
)
from pipelines.reliability import NEAR_NINE, PointKind, reliability_curve, share_right
from pipelines.scored_points import scored_points
from pipelines.stability import StabilityRow, StabilityTable, judged, make_table
from pipelines.track_errors import track_score
from training.criteria import HIDDEN_SCORE, JUDGED_SHARE

EFFORTS: tuple[Effort, ...] = ("balanced", "exact")
_SCENES: tuple[Scenario, ...] = ("traffic", "drive", "parked", "stop_and_go")
_STREETS, _FRAMES, _START = 12, 32, 24
"""Three streets of each scene: one street is a few cars' luck, and a phantom counts for as many frames as it lasts."""
_EMPTY_FPS = 8
_SIZES: dict[int, tuple[float, float]] = {48: (40.0, 57.0), 24: (20.0, 28.5), 12: (10.0, 14.2)}
"""Heights in pixels that are taken for 48, 24 and 12: within a fifth."""

_CONDITIONS: tuple[tuple[str, Condition, float | None, float, float | None], ...] = (
    ("dusk, gain 0.4", "dusk", 0.4, 3.0, 1.0),
    ("night, gain 0.15", "night", 0.15, 15.0, 3.0),
    ("rain streaks", "rain", None, 10.0, 3.0),
    ("windscreen glare", "glare", None, 10.0, 3.0),
    ("motion blur 5 px", "motion_blur", 5.0, 5.0, None),
    ("motion blur 15 px", "motion_blur", 15.0, 20.0, None),
    ("H.264 at crf 40", "h264", 40.0, 8.0, None),
)
"""Name, condition, amount, points of PCK that may be lost, and percent of frames that may have a phantom."""


def stability(*, quick: bool = False) -> StabilityTable:
    """Play every scenario; ``quick`` plays two conditions on half a second of one street."""
    clips = clean_clips(1 if quick else _STREETS, frames=12 if quick else _FRAMES)
    rows: list[StabilityRow] = []
    points: dict[str, np.ndarray] = {}
    for effort in EFFORTS[:1] if quick else EFFORTS:
        clean = [matched(clip, effort) for clip in clips]
        rows += _against_truth("undisturbed", clean, effort)
        if effort == EFFORTS[0]:
            harmed, scored = _conditions(clips, clean, effort, quick=quick)
            rows += harmed
            points = {"undisturbed": _points_of(clean), "in every condition": scored}
        if not quick:
            rows += _played(clips, clean, effort)
    kinds: tuple[PointKind, ...] = ("in view", "hidden")
    curves = tuple(reliability_curve(name, found, kind=kind) for name, found in points.items() for kind in kinds)
    rows += _reliability(points)
    names = ", ".join(dict.fromkeys(clip.name for clip in clips))
    data = (
        f"{len(clips)} streets ({names}) of {len(clips[0])} frames, seeds from {HELD_OUT_SEED}, "
        "objects of 32 px and 30 % in view"
    )
    return replace(make_table("keypoints", data, rows), curves=curves)


def _played(clips: tuple[KeypointClip, ...], clean: list[list[MatchedFrame]], effort: Effort) -> list[StabilityRow]:
    """What happens in time with every effort, since that is where carrying can fail; the rest with the default."""
    rows = [*_crossing(effort), *_cut(clips, effort), *_frozen_second(clips, effort)]
    if effort == EFFORTS[0]:
        rows += [*_boards(clips, clean, effort), *_small_cars(clean, effort), *_empty_road(effort)]
    return rows


def _conditions(
    clips: tuple[KeypointClip, ...], clean: list[list[MatchedFrame]], effort: Effort, *, quick: bool
) -> tuple[list[StabilityRow], np.ndarray]:
    """Every condition's rows, and the scored points of all of them."""
    rows: list[StabilityRow] = []
    points = []
    for name, condition, amount, lost, phantoms in _CONDITIONS[:2] if quick else _CONDITIONS:
        harmed = [matched(clip, effort) for clip in condition_clips(clips, condition, amount)]
        rows += _against_truth(name, harmed, effort, clean=clean, lost=lost, phantoms=phantoms)
        points.append(_points_of(harmed))
    return rows, np.concatenate(points)


def _against_truth(
    name: str, found: list[list[MatchedFrame]], effort: Effort, *, clean: list[list[MatchedFrame]] | None = None,
    lost: float | None = None, phantoms: float | None = None,
) -> list[StabilityRow]:  # fmt: skip
    """Points and phantoms of all clips; against ``clean`` where it is given."""
    frames = [frame for one in found for frame in one]
    scores = {category: point_score(frames, category=category) for category in ("car", "person")}
    note = ", ".join(f"{name} {100 * one.pck:.1f} % of {one.shown}" for name, one in scores.items() if one.shown)
    share, ghosts = 100 * pooled_pck(found), 100 * phantom_frames(frames)
    if clean is None:
        first = judged(name, share, unit="% of points right", method=effort, note=note)
    else:
        drop = 100 * pooled_pck(clean) - share
        first = judged(name, drop, unit="points of PCK lost", at_most=lost, method=effort, note=note)
    haunted = f"{ghosts * len(frames) / 100:.0f} of {len(frames)}"
    return [
        first,
        judged(name, ghosts, unit="% of frames with a phantom", at_most=phantoms, method=effort, note=haunted),
    ]


def _points_of(found: Iterable[Iterable[MatchedFrame]]) -> np.ndarray:
    return np.concatenate([scored_points(frames) for frames in found])


@lru_cache(maxsize=2)
def clean_clips(count: int, *, frames: int) -> tuple[KeypointClip, ...]:
    """``count`` clips, scenes in turn, from the street's second second on."""
    places = (divmod(number, len(_SCENES)) for number in range(count))
    return tuple(
        street_frames(_SCENES[place], HELD_OUT_SEED + 100 * turn + place, frames, start=_START)
        for turn, place in places
    )


@lru_cache(maxsize=1)
def condition_clips(
    clips: tuple[KeypointClip, ...], condition: Condition, amount: float | None
) -> tuple[KeypointClip, ...]:
    """The clips in a condition."""
    return tuple(in_condition(clip, condition, seed=5 + n, amount=amount) for n, clip in enumerate(clips))


def matched(clip: KeypointClip, effort: Effort) -> list[MatchedFrame]:
    """A clip labelled and laid beside its truth."""
    return match_frames(label_clip(clip.frames, effort=effort), clip.truth)


def pooled_pck(found: Iterable[list[MatchedFrame]]) -> float:
    """PCK@0.1 over several clips, 0 to 1."""
    return point_score(frame for frames in found for frame in frames).pck


def _boards(clips: Iterable[KeypointClip], clean: Iterable[list[MatchedFrame]], effort: Effort) -> list[StabilityRow]:
    """Cars behind boards, against the same visible points of the same cars without them."""
    rows = []
    cases = [
        (clip, plain, track) for clip, plain in zip(clips, clean, strict=True) for track in board_targets(clip, most=1)
    ]
    for percent, lost in ((25, 3.0), (50, 8.0), (75, None)):
        before, after = [], []
        for number, (clip, plain, track) in enumerate(cases):
            board = Board(track_id=track, share=percent / 100, from_left=number % 2 == 0)
            covered = behind_board(clip, board)
            after += only_track(matched(covered, effort), track, covered, clip)
            before += [with_truth(frame, covered, track) for frame in only_track(plain, track, covered, clip)]
        drop = 100 * (point_score(before).pck - point_score(after).pck)
        name = f"{percent} % of a car behind a board"
        note = f"{100 * point_score(after).pck:.1f} % of {point_score(after).shown} points"
        rows.append(judged(name, drop, unit="points of PCK lost", at_most=lost, method=effort, note=note))
        low, count = hidden_below(after)
        rows.append(
            judged(
                name, 100 * low, unit="% of hidden points scored below 0.3", at_least=90.0, method=effort,
                note=f"{count} points",
            )
        )  # fmt: skip
    return rows


def only_track(
    frames: Iterable[MatchedFrame], track: int, covered: KeypointClip, plain: KeypointClip
) -> list[MatchedFrame]:
    """The frames in which a board stands before the track, with that track alone."""
    chosen = []
    for frame in frames:
        if covered.frames[frame.frame] is not plain.frames[frame.frame]:
            pairs = tuple(pair for pair in frame.pairs if pair[0].track_id == track and pair[0].category == "car")
            chosen.append(replace(frame, pairs=pairs, phantoms=()))
    return chosen


def with_truth(frame: MatchedFrame, clip: KeypointClip, track: int) -> MatchedFrame:
    """What was found of a track, laid beside another clip's truth of it."""
    (thing,) = (thing for thing in clip.truth[frame.frame] if thing.track_id == track and thing.category == "car")
    return replace(frame, pairs=tuple((thing, label) for _, label in frame.pairs))


def hidden_below(frames: Iterable[MatchedFrame]) -> tuple[float, int]:
    """Share of the hidden points of found objects that score below 0.3; and how many there are."""
    scores = [
        label.points[: len(thing.visible)][~thing.visible, 2]
        for frame in frames
        for thing, label in frame.judged
        if label is not None
    ]
    pooled = np.concatenate([np.zeros(0), *scores])
    return float((pooled < HIDDEN_SCORE).mean()) if len(pooled) else float("nan"), len(pooled)


def _small_cars(clean: list[list[MatchedFrame]], effort: Effort) -> list[StabilityRow]:
    rows = []
    frames = [frame for one in clean for frame in one]
    for height, (low, high) in _SIZES.items():
        found, asked = recall(frames, category="car", from_px=low, to_px=high)
        least = {48: 95.0, 24: 80.0}.get(height)
        share = 100 * found / asked if asked else float("nan")
        rows.append(
            judged(
                f"cars {height} px high", share, unit="% found", at_least=least, method=effort, note=f"of {asked}"
            )
        )  # fmt: skip
    return rows


def _crossing(effort: Effort) -> list[StabilityRow]:
    """Two people who cross, one of whom passes behind a column for a second."""
    clip = crossing_clip()
    labels = label_clip(clip.frames, effort=effort)
    crossing = hidden = 0
    for track, first_back in column_passages(clip).items():
        # The first change after coming back from behind the column is the occlusion's, the rest the crossing's.
        switches = id_switches(labels, clip, track)
        late = [frame for frame in switches if first_back is not None and frame >= first_back][:1]
        hidden += len(late)
        crossing += len(switches) - len(late)
    score = track_score(labels, clip.truth, categories=("person",))
    note = f"IDF1 {score.idf1:.2f}, {score.missed} of {score.objects} missed"
    return [
        judged("two people cross", float(crossing), unit="id switches", at_most=0, method=effort, note=note),
        judged("one second behind a column", float(hidden), unit="id switches", at_most=1, method=effort, note=note),
    ]


@lru_cache(maxsize=1)
def crossing_clip() -> KeypointClip:
    """Seven seconds of the crossing scene."""
    return street_frames("crossing", HELD_OUT_SEED + 10, 168)


def column_passages(clip: KeypointClip) -> dict[int, int | None]:
    """By track of the people: the frame in which they come back into view, or None where they never left it."""
    seen: dict[int, list[int]] = {}
    for frame, things in enumerate(clip.truth):
        for thing in things:
            if thing.category == "person" and thing.visible_share > JUDGED_SHARE:
                seen.setdefault(thing.track_id, []).append(frame)
    gaps = {
        track: [b for a, b in zip(frames[:-1], frames[1:], strict=True) if b - a > 6] for track, frames in seen.items()
    }
    return {track: (back[0] if back else None) for track, back in gaps.items()}


def id_switches(labels: Iterable[Keypoints], clip: KeypointClip, track: int) -> list[int]:
    """The frames in which a true person is found under another id than before."""
    last, changes = None, []
    for frame in match_frames(labels, clip.truth, categories=("person",)):
        for thing, label in frame.judged:
            if thing.track_id == track and label is not None:
                if last not in (None, label.track_id):
                    changes.append(frame.frame)
                last = label.track_id
    return changes


def _cut(clips: tuple[KeypointClip, ...], effort: Effort) -> list[StabilityRow]:
    at = len(clips[0]) // 2
    clip, cuts = spliced(clips[0], clips[1], at=at)
    found = float(cuts == {at})
    rows = [judged("a cut", found, unit="found where it is, and no other", at_least=1.0, method=effort)]
    for name, breaks in (("a cut", cuts), ("a cut that nobody tells of", frozenset())):
        labels = label_clip(clip.frames, effort=effort, breaks=breaks)
        before = {label.track_id for label in labels if label.frame < at}
        carried = sum(label.track_id in before for label in labels if label.frame >= at)
        bound = 0 if breaks else None
        rows.append(judged(name, float(carried), unit="objects carried across", at_most=bound, method=effort))
    return rows


def _frozen_second(clips: tuple[KeypointClip, ...], effort: Effort) -> list[StabilityRow]:
    at = len(clips[0]) // 2
    # A job's runs are coded again, and the cut tells of pictures that its source showed again.
    clip = in_condition(frozen(clips[0], at=at, frames=24), "h264", seed=0, amount=EncoderSettings().crf)
    rows = []
    for name, repeats in (
        ("a frozen second", frozenset(range(at + 1, at + 25))), ("a frozen second that nobody tells of", frozenset()),
    ):  # fmt: skip
        labels = label_clip(clip.frames, effort=effort, repeats=repeats)
        # Smoothing looks half a second each way: in between, only the picture that stands still is seen.
        drifts = drift_shares(labels, first=at + 6, last=at + 18)
        worst = 100 * float(max(drifts, default=0.0))
        note = f"the worst of {len(drifts)} objects, median of its points"
        bound = 1.0 if repeats else None
        unit = "% of the box diagonal drifted"
        rows.append(judged(name, worst, unit=unit, at_most=bound, method=effort, note=note))
    return rows


def drift_shares(labels: Iterable[Keypoints], *, first: int, last: int) -> list[float]:
    """For each track in both frames, how far its points went, by the median, in box diagonals."""
    ends = ({label.track_id: label for label in labels if label.frame == frame} for frame in (first, last))
    start, end = ends
    shares = []
    for track in sorted(start.keys() & end.keys()):
        both = start[track].present & end[track].present
        if both.any():
            step = np.linalg.norm((end[track].points - start[track].points)[both, :2], axis=1)
            shares.append(float(np.median(step)) / box_diagonal(start[track].box_xyxy))
    return shares


def _empty_road(effort: Effort) -> list[StabilityRow]:
    """A minute of a road without anybody, rendered as it is looked at: 3 GB of frames are not kept."""
    phantoms = track_spans(label_clip(empty_road(), effort=effort))
    longest = max(phantoms.values(), default=0)
    return [
        judged(
            "an empty road, 1 min", longest / 24, unit="s, the longest phantom", at_most=0.25, method=effort,
            note=f"{len(phantoms)} phantom tracks; filmed at {_EMPTY_FPS} fps",
        )
    ]  # fmt: skip


def empty_road() -> Iterator[np.ndarray]:
    """The 1440 frames of a minute; filmed at few frames per second, which is all that is looked at."""
    street = Street(StreetConfig(seed=HELD_OUT_SEED + 20, scenario="empty", frames=60 * _EMPTY_FPS, fps=_EMPTY_FPS))
    for number in range(len(street)):
        picture = street.render(number).rgb
        for _ in range(24 // _EMPTY_FPS):
            yield picture


def _reliability(points: dict[str, np.ndarray]) -> list[StabilityRow]:
    rows = []
    for name, found in points.items():
        share, count = share_right(found, low=NEAR_NINE[0], high=NEAR_NINE[1])
        above, many = share_right(found, low=NEAR_NINE[0])
        rows.append(
            judged(
                f"points that score 0.9, {name}", 100 * share, unit="% right", at_least=85.0, method=EFFORTS[0],
                note=f"of {count}; {100 * above:.1f} % of {many} from {NEAR_NINE[0]:g} on",
            )
        )  # fmt: skip
    return rows

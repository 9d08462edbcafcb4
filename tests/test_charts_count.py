"""The chart of counting looks: what counts as a clip kept wrongly."""

import numpy as np
import pytest

from labeling.timeline import plan_clips, plan_timeline
from pipelines.charts_count import _QUICK, _SCENARIOS, _WHOLE, _missed


@pytest.mark.parametrize(
    ("counts", "truth", "missed"),
    [
        ([[1, 2], [3, 4]], [[10, 20], [30, 40]], 0.0),
        ([[4, 3], [2, 1]], [[1, 2], [3, 4]], 100.0),
        ([[0, 0], [0, 0]], [[1, 2], [3, 4]], 50.0),
        ([[1, 2], [3, 4]], [[0, 0], [0, 0]], 50.0),
    ],
    ids=["the same order", "the reverse", "too many kept", "too few kept"],
)
def test_too_many_and_too_few_count_alike(counts, truth, missed) -> None:
    """Half of four clips are kept, and all of those that tie."""
    assert _missed(counts, truth) == missed


@pytest.mark.parametrize("size", [_WHOLE, _QUICK], ids=["whole", "quick"])
def test_every_video_has_clips_to_rank(size) -> None:
    timeline = plan_timeline(np.arange(size.frames) / 24)
    clips = plan_clips(timeline, clip_frames=size.clip_frames, stride_frames=size.stride_frames).kept
    assert len(clips) >= 2 and 2 < size.videos <= len(_SCENARIOS)
    assert _QUICK.videos * _QUICK.frames < _WHOLE.videos * _WHOLE.frames / 10

"""The chart of counting looks: what counts as a clip kept wrongly."""

import pytest

from pipelines.charts_count import _missed


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

"""Medians of ragged groups are those of each group alone."""

import numpy as np

from labeling.medians import masked_median


def test_every_group_has_its_own_median() -> None:
    rng = np.random.default_rng(0)
    for shape in ((7, 9), (7, 9, 2), (3, 1), (0, 4)):
        values, mask = rng.normal(size=shape), rng.random(shape[:2]) < 0.6
        expected = [np.median(v[m], axis=0) if m.any() else 0 * v[0] for v, m in zip(values, mask, strict=True)]
        np.testing.assert_allclose(masked_median(values, mask), np.array(expected).reshape(shape[0], *shape[2:]))

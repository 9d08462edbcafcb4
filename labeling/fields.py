"""Bottom-up keypoints: composite intensity and association fields (CIF and CAF), grown into objects.

OpenPifPaf: Kreiss, Bertoni, Alahi 2019 and 2021. Written from the papers; no code of it is used.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from labeling.labels import Keypoints
from labeling.model_cards import CifcafCard, FieldHeadCard
from labeling.onnx_model import DEFAULT_PROVIDERS, OnnxModel


class FieldDecoder:
    """Turns one pair of fields into objects.

    Args:
        head: schema and thresholds.
        stride: pixels per cell.
    """

    def __init__(self, head: FieldHeadCard, *, stride: int) -> None:
        self.head, self.stride = head, stride

    def decode(self, cif: np.ndarray, caf: np.ndarray) -> list[tuple[np.ndarray, float]]:
        """The objects of one frame, best first.

        Args:
            cif: (K, 5, h, w) float32: -, confidence, x, y, scale per cell; x, y, scale in cells.
            caf: (E, 8, h, w) float32: -, confidence, x1, y1, x2, y2, s1, s2.

        Returns:
            Pairs of (K, 3) float32 points (x, y in input pixels, score; 0 = absent) and the object's score, 0 to 1.
        """
        raise NotImplementedError


class FieldModel:
    """A CIF/CAF network behind its card; one network may serve several schemas (cars and lanes).

    Raises:
        ModelError: as ``OnnxModel``.
    """

    def __init__(
        self,
        card: CifcafCard,
        path: Path,
        *,
        providers: Sequence[str] = DEFAULT_PROVIDERS,
        threads: int = 1,
        max_batch: int = 4,
    ) -> None:
        self.card = card
        self.model = OnnxModel(card, path, providers=providers, threads=threads, max_batch=max_batch)

    @property
    def schema_names(self) -> tuple[str, ...]:
        """Schemas of the objects that ``estimate`` gives."""
        return tuple(head.schema_name for head in self.card.heads)

    def estimate(self, frames: Sequence[np.ndarray], *, first_frame: int = 0) -> list[list[Keypoints]]:
        """Untracked objects of each frame, in frame pixels; frame *i* of the list is numbered ``first_frame + i``.

        Args:
            frames: (H, W, 3) uint8 RGB; scaled to fit where they are not of the network's size.
            first_frame: number of the first on the video's 24 fps grid.

        Raises:
            ModelError: a frame that is no RGB picture, or a network's output that is not finite.
        """
        raise NotImplementedError

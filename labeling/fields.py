"""Bottom-up keypoints: composite intensity and association fields (CIF and CAF), grown into objects.

PifPaf, Kreiss, Bertoni, Alahi 2019, and OpenPifPaf, the same 2021. Written from the papers: no code of it is used.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from labeling import field_growth as growth
from labeling.labels import POINT_ABSENT, POINT_DETECTED, Keypoints
from labeling.model_cards import CifcafCard, FieldHeadCard
from labeling.onnx_model import DEFAULT_PROVIDERS, OnnxModel, check_frame, network_input
from labeling.schemas import CATEGORIES, Category, keypoint_schema

_BEST_POINTS, _BEST_WEIGHT = 3, 3.0
"""An object's score is the mean over all K points, the three best counted three times (PifPaf)."""


class FieldDecoder:
    """Turns one pair of fields into objects.

    Args:
        head: schema and thresholds.
        stride: pixels per cell.

    Attributes:
        left_out: seeds of objects beyond the card's ``max_objects``, over all frames so far.
    """

    def __init__(self, head: FieldHeadCard, *, stride: int) -> None:
        self.head, self.stride = head, stride
        self.left_out = 0
        table = keypoint_schema(head.schema_name)
        self.edges = np.array(table.edges)
        self.graph = _graph(self.edges, table.point_count)

    def decode(self, cif: np.ndarray, caf: np.ndarray) -> list[tuple[np.ndarray, float]]:
        """The objects of one frame, best first; the ``max_objects`` best where there are more.

        Args:
            cif: (K, 5, h, w) float32: -, confidence, x, y, scale per cell; x, y, scale in cells.
            caf: (E, 8, h, w) float32: -, confidence, x1, y1, x2, y2, s1, s2.

        Returns:
            Pairs of (K, 3) float32 points (x, y in input pixels, score; 0 = absent) and the object's score, 0 to 1.
        """
        objects = self._grow(cif, caf)
        objects = objects[np.argsort(-object_scores(objects[:, :, 3]), kind="stable")]
        growth.suppress_points(objects)
        objects[objects[:, :, 3] < self.head.point_threshold] = 0
        scores = object_scores(objects[:, :, 3])
        found = []
        for n in np.argsort(-scores, kind="stable"):
            enough = growth.largest_component(objects[n, :, 3] > 0, self.edges) >= self.head.min_points
            if scores[n] >= self.head.instance_threshold and enough:
                found.append((objects[n][:, [0, 1, 3]].astype(np.float32), float(scores[n])))
        return found

    def _grow(self, cif: np.ndarray, caf: np.ndarray) -> np.ndarray:
        head, stride = self.head, float(self.stride)
        height, width = cif.shape[2] * stride, cif.shape[3] * stride
        cells = growth.gather_cells(cif, head.map_threshold, stride)
        index = growth.index_map(cells, len(cif), width, height)
        seed_scores = growth.score_seeds(index, cells)
        seeds = np.flatnonzero(seed_scores >= head.seed_threshold)
        seeds = seeds[np.argsort(-seed_scores[seeds], kind="stable")]
        links = growth.gather_connections(caf, head.connection_threshold, stride, width)
        objects, left_out = growth.grow_all(
            seeds, seed_scores, cells, links, index, self.graph,
            head.growth_threshold, head.relative_threshold, head.max_objects,
        )  # fmt: skip
        self.left_out += int(left_out)
        return objects


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
        self.decoders = tuple(FieldDecoder(head, stride=card.stride) for head in card.heads)

    @property
    def left_out(self) -> int:
        """Seeds of objects beyond what the card allows in a frame, over all frames so far."""
        return sum(decoder.left_out for decoder in self.decoders)

    @property
    def schema_names(self) -> tuple[str, ...]:
        """Schemas of the objects that ``estimate`` gives."""
        return tuple(head.schema_name for head in self.card.heads)

    def estimate(
        self, frames: Sequence[np.ndarray], *, first_frame: int = 0, categories: Collection[Category] = CATEGORIES
    ) -> list[list[Keypoints]]:
        """Untracked objects of each frame, in frame pixels; frame *i* of the list is numbered ``first_frame + i``.

        Args:
            frames: (H, W, 3) uint8 RGB; scaled to fit where they are not of the network's size.
            first_frame: number of the first on the video's 24 fps grid.
            categories: what is wanted: fields of others are not decoded.

        Raises:
            ModelError: a frame that is no RGB picture, or a network's output that is not finite.
        """
        wanted = [n for n, name in enumerate(self.schema_names) if keypoint_schema(name).category in categories]
        outputs = [2 * n + side for n in wanted for side in (0, 1)]
        found: list[list[Keypoints]] = []
        for start in range(0, len(frames), self.model.max_batch):
            chunk = frames[start : start + self.model.max_batch]
            batch = np.empty((len(chunk), 3, self.card.input_height, self.card.input_width), np.float32)
            ratios = [padded_input(frame, self.card, out=planes)[1] for frame, planes in zip(chunk, batch, strict=True)]
            fields = self.model.run(batch, outputs=outputs)
            for i, ratio in enumerate(ratios):
                pairs = {n: (fields[2 * k][i], fields[2 * k + 1][i]) for k, n in enumerate(wanted)}
                found.append(self._objects(pairs, ratio=ratio, frame=first_frame + start + i))
        return found

    def _objects(
        self, pairs: Mapping[int, tuple[np.ndarray, np.ndarray]], *, ratio: float, frame: int
    ) -> list[Keypoints]:
        """Objects of one frame from the pairs of fields of some decoders, by their places."""
        objects = []
        for n, (cif, caf) in pairs.items():
            decoder = self.decoders[n]
            for points, score in decoder.decode(cif, caf):
                # Pixel centres lie on integers in both pictures.
                present = points[:, 2] > 0
                points[present, :2] = (points[present, :2] + 0.5) / ratio - 0.5
                objects.append(_keypoints(points, score, schema_name=decoder.head.schema_name, frame=frame))
        return objects


def padded_input(frame: np.ndarray, card: CifcafCard, *, out: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """The network's input for one frame, and its scale relative to the frame.

    The frame is scaled to fit into the input less its one extra row and column, put at the top left, and padded with
    the mean colour, right and bottom.

    Args:
        frame: (H, W, 3) uint8 RGB.
        card: size and normalisation.
        out: where the input goes; a new array by default.

    Returns:
        (3, input_height, input_width) float32, and the scale.

    Raises:
        ModelError: the frame is not (H, W, 3) uint8, or empty.
    """
    check_frame(frame)
    ratio = min((card.input_width - 1) / frame.shape[1], (card.input_height - 1) / frame.shape[0])
    if ratio != 1:
        size = (max(1, round(frame.shape[1] * ratio)), max(1, round(frame.shape[0] * ratio)))
        frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA if ratio < 1 else cv2.INTER_LINEAR)
    height, width = frame.shape[:2]
    planes = np.empty((3, card.input_height, card.input_width), np.float32) if out is None else out
    network_input(frame, card, out=planes[:, :height, :width])
    planes[:, height:], planes[:, :height, width:] = 0, 0
    return planes, ratio


def object_scores(point_scores: np.ndarray) -> np.ndarray:
    """(M,) scores of objects from (M, K) scores of their points: a mean, the three best counted three times."""
    weights = np.ones(point_scores.shape[1])
    weights[:_BEST_POINTS] = _BEST_WEIGHT
    return np.sort(point_scores, axis=1)[:, ::-1] @ (weights / weights.sum())


def _graph(edges: np.ndarray, kinds: int) -> growth.Graph:
    source, target = edges.ravel(), edges[:, ::-1].ravel()
    leaving = np.argsort(source, kind="stable")
    starts = np.searchsorted(source[leaving], np.arange(kinds + 1))
    return growth.Graph(source, target, starts, leaving)


def _keypoints(points: np.ndarray, score: float, *, schema_name: str, frame: int) -> Keypoints:
    present = points[:, 2] > 0
    corners = [points[present, :2].min(axis=0), points[present, :2].max(axis=0)]
    return Keypoints(
        frame=frame, category=keypoint_schema(schema_name).category, schema=schema_name, score=min(score, 1.0),
        box_xyxy=np.concatenate(corners).astype(np.float32), points=points,
        point_source=np.where(present, POINT_DETECTED, POINT_ABSENT).astype(np.int8),
    )  # fmt: skip

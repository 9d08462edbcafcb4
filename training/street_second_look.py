"""A second look at what the detector's cells claim: each candidate is judged again, by what its box shows and beside
the others.

A cell of the first look neither knows which of its neighbours claims the same object nor sees more of a sliver behind a
post than its own few features. Here the best candidates are sampled inside their boxes (He et al. 2017, RoIAlign,
without pooling), told what stands around them (Hosang et al. 2017, *Learning non-maximum suppression*), and scored so
that of each object one candidate is left: nothing needs to be suppressed afterwards. All of it is part of the graph.

Shape suffixes as in ``street_networks``; M candidates of a picture, Q points sampled in a box.
"""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from labeling.model_cards import DETECTOR_STRIDES
from training.street_networks import MAX_LOG_SIZE, FirstLook, StreetDetector

CANDIDATES, OBJECTS = 128, 64
"""Of a picture's cells so many of the best are compared, and so many of those looked at again; the rest are nothing."""
_COLUMNS, _ROWS = 4, 6
"""Points sampled in a box: enough to tell a walker's legs from a post's foot."""
_FINE_STRIDE = 4
_DOUBLE_IOU = 0.65
_ROUNDS = 5
"""Of clearing doubles in parallel: exact where no chain of boxes, each the double of the one before, is longer."""
_SIGMA, _PART_COST = 0.4, 0.4
"""Of soft suppression (Bodla et al. 2017) and of parts, from which the second look starts: as they were chosen for the
first look alone, on the validation streets."""
_WAISTS = (32, 64, 112, 128)
"""Of the first look's residual units. At fine strides narrower ones than their stages pay for a larger picture."""
_LEAST = -9.0
"""Log score of what is as good as nothing."""
_NOTHING = 0.01
"""What scores less is given as nothing: which cells are the last candidates of an empty street is chance."""
_PAIR_WIDTH, _NEAR = 32, 2.0
"""Channels of what one candidate tells another, and from how many of its sides away it does."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """The best of a picture's cells, one per box."""

    index: torch.Tensor
    """(N, M) int64: cell."""
    rows: torch.Tensor
    """(N, M, 5 + C) as the detector gives them."""
    boxes_xyxy: torch.Tensor
    """(N, M, 4) input pixels."""
    strides: torch.Tensor
    """(N, M) pixels per cell."""
    softened: torch.Tensor
    """(N, M) log score of the best class, less what better candidates take from it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SecondScores:
    """What the second look makes of a picture's candidates."""

    candidates: Candidates
    logits: torch.Tensor
    """(N, M, C): of being the one candidate of an object of each class."""


def best_candidates(first: FirstLook) -> Candidates:
    """The candidates worth a second look, softened by one another.

    Doubles are cleared and overlaps softened for all at once, not one after the other, so that it can be part of a
    graph: a candidate that a better one of its class overlaps by more than ``_DOUBLE_IOU`` is cleared, and those that
    are left take from the weaker as in ``labeling.detection.soften_overlaps``.
    """
    rows = first.rows.detach()
    cells, strides = _grid(first.coarse)
    # The best class first, then logarithms: of thousands of cells these are dear.
    by_value = rows.transpose(1, 2)
    scores = -functional.softplus(-by_value[:, 4]) - functional.softplus(-by_value[:, 5:].amax(dim=1))
    index = scores.topk(min(CANDIDATES, scores.shape[1]), dim=1).indices
    found = Candidates(
        index=index, rows=_pick(rows, index), boxes_xyxy=decode_boxes(_pick(rows, index), cells[index], strides[index]),
        strides=strides[index], softened=scores.gather(1, index),
    )  # fmt: skip
    softened = _soften(found)
    best = softened.topk(min(OBJECTS, softened.shape[1]), dim=1).indices
    return Candidates(
        index=index.gather(1, best), rows=_pick(found.rows, best), boxes_xyxy=_pick(found.boxes_xyxy, best),
        strides=found.strides.gather(1, best), softened=softened.gather(1, best),
    )  # fmt: skip


def _grid(coarse: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Column and row (A, 2) and stride (A,) of each cell, from the features at the finest stride."""
    cells, strides = [], []
    for stride in DETECTOR_STRIDES:
        step = stride // DETECTOR_STRIDES[0]
        rows, columns = (
            torch.arange(coarse.shape[axis] // step, device=coarse.device, dtype=torch.float32) for axis in (2, 3)
        )
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        cells.append(torch.stack([x.flatten(), y.flatten()], dim=1))
        strides.append(torch.full_like(cells[-1][:, 0], stride))
    return torch.cat(cells), torch.cat(strides)


def _log_scores(rows: torch.Tensor) -> torch.Tensor:
    """(..., C) logarithm of objectness times class score."""
    # Not logsigmoid: a graph takes the logarithm of a sigmoid for it, which is 0 where there is nothing at all.
    return -functional.softplus(-rows[..., 4:5]) - functional.softplus(-rows[..., 5:])


def _pick(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """(N, M, D) those of (N, A, D) that (N, M) names."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[2]))


def decode_boxes(rows: torch.Tensor, cells: torch.Tensor, strides: torch.Tensor) -> torch.Tensor:
    """(..., 4) boxes in input pixels of rows (..., 5 + C), given their cells (..., 2) and strides (...)."""
    centres = (rows[..., :2] + cells) * strides[..., None]
    halves = rows[..., 2:4].clamp(max=MAX_LOG_SIZE).exp() * strides[..., None] / 2
    return torch.cat([centres - halves, centres + halves], dim=-1)


def _soften(found: Candidates) -> torch.Tensor:
    classes = _log_scores(found.rows).argmax(dim=2)
    scores, boxes = found.softened, found.boxes_xyxy
    better = (scores[:, :, None] > scores[:, None, :]) & (classes[:, :, None] == classes[:, None, :])
    overlap, inside = pair_overlap(boxes, boxes)
    double = (better & (overlap > _DOUBLE_IOU)).float()
    alive = torch.ones_like(scores)
    for _ in range(_ROUNDS):
        alive = 1 - (double * alive[:, :, None]).amax(dim=1)
    share = torch.minimum(torch.exp(-(overlap**2) / _SIGMA), 1 - _PART_COST * inside.transpose(1, 2))
    taken = (share.log() * better.float() * alive[:, :, None]).sum(dim=1)
    return (scores + taken).clamp(min=_LEAST) + _LEAST * (1 - alive)


def pair_overlap(boxes: torch.Tensor, others: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Intersection over union of boxes (N, M, 4) with others (N, G, 4), and the share of each that is inside the other.

    Both are (N, M, G); areas below 1e-6 count as that.
    """
    shared = _shared(boxes, others, 0) * _shared(boxes, others, 1)
    areas, other_areas = _areas(boxes), _areas(others)
    union = (areas[:, :, None] + other_areas[:, None, :] - shared).clamp(min=1e-6)
    return shared / union, shared / areas[:, :, None]


def _shared(boxes: torch.Tensor, others: torch.Tensor, axis: int) -> torch.Tensor:
    """(N, M, G) length that two boxes share along one axis: axis by axis, since rows of two numbers are slow."""
    low = torch.maximum(boxes[:, :, None, axis], others[:, None, :, axis])
    high = torch.minimum(boxes[:, :, None, axis + 2], others[:, None, :, axis + 2])
    return (high - low).clamp(min=0)


def _areas(boxes: torch.Tensor) -> torch.Tensor:
    sides = boxes[..., 2:] - boxes[..., :2]
    return (sides[..., 0] * sides[..., 1]).clamp(min=1e-6)


def sample_boxes(features: torch.Tensor, boxes_xyxy: torch.Tensor, stride: int) -> torch.Tensor:
    """(N, M, Q, D) features at ``_COLUMNS`` by ``_ROWS`` even points of each box, linear between cells.

    Args:
        features: (N, D, h, w); cell i is centred on input pixel i * stride.
        boxes_xyxy: (N, M, 4) input pixels; beyond the picture there is nothing, which is 0.
        stride: pixels per cell.
    """
    places = []
    for axis, points in ((0, _COLUMNS), (1, _ROWS)):
        shares = (torch.arange(points, device=features.device) + 0.5) / points
        low, high = boxes_xyxy[..., axis, None], boxes_xyxy[..., axis + 2, None]
        places.append(2 * (low + (high - low) * shares) / (stride * _last(features, 3 - axis)) - 1)
    x = places[0][:, :, None, :].expand(-1, -1, _ROWS, -1)
    y = places[1][:, :, :, None].expand(-1, -1, -1, _COLUMNS)
    grid = torch.stack([x, y], dim=-1).flatten(2, 3)
    return functional.grid_sample(features, grid, align_corners=True).permute(0, 2, 3, 1)


def _last(features: torch.Tensor, axis: int) -> torch.Tensor:
    """Index of an axis's last cell; a tensor, so that a graph keeps to the size of whatever picture it is given."""
    return torch.arange(features.shape[axis], device=features.device)[-1]


class _Neighbours(nn.Module):
    """One round of what candidates tell one another: the loudest and the sum of what is said are taken in."""

    def __init__(self, width: int, relations: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.listener, self.speaker = nn.Linear(width, _PAIR_WIDTH), nn.Linear(width, _PAIR_WIDTH)
        self.relation = nn.Linear(relations, _PAIR_WIDTH)
        self.message = nn.Linear(_PAIR_WIDTH, _PAIR_WIDTH)
        self.taken_in = nn.Linear(2 * _PAIR_WIDTH, width)
        self.thought_over = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.ReLU(inplace=True), nn.Linear(2 * width, width)
        )
        nn.init.zeros_(self.taken_in.weight)
        nn.init.zeros_(self.taken_in.bias)

    def forward(self, x: torch.Tensor, relations: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
        """(N, M, width) from the same, relations (N, M, M, R) and (N, M, M) 0 or 1: who hears whom."""
        own = self.norm(x)
        said = self.listener(own)[:, :, None] + self.speaker(own)[:, None] + self.relation(relations)
        said = self.message(said.relu()).relu() * near[..., None]
        x = x + self.taken_in(torch.cat([said.amax(dim=2), said.sum(dim=2) / 4], dim=2))
        return x + self.thought_over(x)


class SecondLook(nn.Module):
    """Scores of candidates, beginning at those of the first look, softened: untrained, it changes nothing.

    Args:
        classes: C.
        fine: channels of the features at stride 4.
        pyramid: channels of those at stride 8 and of the cells.
        width: of what is known of a candidate.
    """

    _RELATIONS = 13

    def __init__(self, classes: int, *, fine: int, pyramid: int, width: int = 72) -> None:
        super().__init__()
        points = _COLUMNS * _ROWS
        kept = {"fine": 12, "coarse": 20}
        self.reduce_fine, self.reduce_coarse = nn.Linear(fine, kept["fine"]), nn.Linear(pyramid, kept["coarse"])
        self.see_fine = nn.Linear(kept["fine"] * points, width, bias=False)
        self.see_coarse = nn.Linear(kept["coarse"] * points, width, bias=False)
        self.cell, self.place = nn.Linear(pyramid, width), nn.Linear(11 + classes, width)
        self.mix = nn.Sequential(nn.ReLU(), nn.Linear(width, width))
        self.neighbours = nn.ModuleList(_Neighbours(width, self._RELATIONS) for _ in range(2))
        self.norm, self.score = nn.LayerNorm(width), nn.Linear(width, classes)
        self.forget = nn.Dropout(0.1)
        nn.init.zeros_(self.score.weight)
        nn.init.zeros_(self.score.bias)

    def forward(self, found: Candidates, first: FirstLook) -> torch.Tensor:
        """(N, M, C) logits of the candidates that a first look found."""
        boxes = found.boxes_xyxy
        seen = _see(first.fine, self.reduce_fine, boxes, _FINE_STRIDE)
        seen_coarsely = _see(first.coarse, self.reduce_coarse, boxes, DETECTOR_STRIDES[0])
        index = found.index[:, None].expand(-1, first.cell_features.shape[1], -1)
        own = first.cell_features.gather(2, index).transpose(1, 2)
        x = self.cell(own) + self.place(_places(found, first.coarse))
        x = x + self.see_coarse(self.forget(seen_coarsely)) + self.see_fine(self.forget(seen))
        x = x + self.mix(x)
        relations, near = _relations(found)
        for listen in self.neighbours:
            x = listen(x, relations, near)
        scores = _log_scores(found.rows)
        before = (scores - scores.amax(dim=2, keepdim=True) + found.softened[..., None]).clamp(min=-12.0)
        return before - torch.log1p(-before.exp().clamp(max=1 - 1e-4)) + self.score(self.norm(x))


def _see(features: torch.Tensor, reduce: nn.Linear, boxes: torch.Tensor, stride: int) -> torch.Tensor:
    """(N, M, Q D) reduced features at the points of each box.

    Reduced before they are sampled, which is the same and cheaper; but for the bias, which holds outside as well.
    """
    reduced = functional.conv2d(features, reduce.weight[:, :, None, None])
    return (sample_boxes(reduced, boxes, stride) + reduce.bias).relu().flatten(2)


def _sides_and_middles(boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return (boxes[..., 2:] - boxes[..., :2]).clamp(min=1.0), (boxes[..., 2:] + boxes[..., :2]) / 2


def _places(found: Candidates, coarse: torch.Tensor) -> torch.Tensor:
    """(N, M, 11 + C) numbers of about one: where each is, how large, how sure."""
    sides, middles = _sides_and_middles(found.boxes_xyxy)
    width, height = (DETECTOR_STRIDES[0] * (_last(coarse, axis) + 1) for axis in (3, 2))
    parts = [
        sides.log() - 4, middles[..., :1] / width - 0.5, middles[..., 1:] / height - 0.5,
        found.boxes_xyxy / 512 - 0.7, found.rows[..., 4:] / 4, found.strides[..., None].log2() - 4,
        found.softened[..., None] / 3,
    ]  # fmt: skip
    return torch.cat(parts, dim=2)


def _relations(found: Candidates) -> tuple[torch.Tensor, torch.Tensor]:
    """(N, M, M, R) numbers of about one that say how each candidate stands to another, and (N, M, M) 1 where near."""
    boxes, scores = found.boxes_xyxy, found.softened
    sides, middles = _sides_and_middles(boxes)
    overlap, inside = pair_overlap(boxes, boxes)
    ahead = scores[:, :, None] - scores[:, None, :]
    kinds = found.rows[..., 5:].softmax(dim=2)
    logs = sides.log()
    apart = [(middles[:, :, None, i] - middles[:, None, :, i]) / sides[:, :, None, i] for i in (0, 1)]
    larger = [logs[:, :, None, i] - logs[:, None, :, i] for i in (0, 1)]
    farthest = torch.maximum(*(one.abs() for one in apart))
    itself = torch.eye(boxes.shape[1], device=boxes.device)
    near = (torch.minimum(farthest, farthest.transpose(1, 2)) < _NEAR).float() * (1 - itself)
    parts = [
        overlap, inside, inside.transpose(1, 2), (overlap > 0.3).float(),
        ahead.clamp(-4, 4) / 2, (ahead > 0).float(), kinds @ kinds.transpose(1, 2),
        *(one.clamp(-3, 3) for one in (*apart, *larger)),
        scores[:, None, :].expand_as(overlap).clamp(min=-6) / 3,
        scores[:, :, None].expand_as(overlap).clamp(min=-6) / 3,
    ]  # fmt: skip
    return torch.stack(parts, dim=3), near


class TwoLookDetector(nn.Module):
    """A street detector that looks twice."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.first = StreetDetector(classes, waists=_WAISTS)
        self.second = SecondLook(classes, fine=self.first.fine_channels, pyramid=self.first.head.in_channels)

    def forward(self, pictures: torch.Tensor) -> tuple[FirstLook, SecondScores]:
        """Both looks at (N, 3, H, W) normalised BGR, H and W multiples of 32.

        Where the second looks is not learnt from what it sees there: candidates carry no gradient.
        """
        first = self.first.look(pictures)
        # Places and overlaps need more digits than bfloat16 has.
        with torch.autocast(pictures.device.type, enabled=False):
            first = FirstLook(
                rows=first.rows.float(), cell_features=first.cell_features.float(), fine=first.fine.float(),
                coarse=first.coarse.float(),
            )  # fmt: skip
            found = best_candidates(first)
            return first, SecondScores(candidates=found, logits=self.second(found, first))


class TwoLookGraph(nn.Module):
    """``TwoLookDetector`` as the ``yolox`` contract wants it: all but the candidates score nothing."""

    def __init__(self, network: TwoLookDetector) -> None:
        super().__init__()
        self.network = network

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """``output`` (N, A, 5 + C); the best class of a candidate is sure to be its class if it is anything."""
        first, second = self.network(pictures)
        scores = second.logits.sigmoid()
        best = scores.amax(dim=2, keepdim=True)
        best = best * (best > _NOTHING).float()
        judged = torch.cat([best, scores / best.clamp(min=_NOTHING)], dim=2) * (best > 0).float()
        index = second.candidates.index[..., None].expand_as(judged)
        rows = torch.zeros_like(first.rows[..., 4:]).scatter(1, index, judged)
        return torch.cat([first.rows[..., :2], first.rows[..., 2:4].clamp(max=MAX_LOG_SIZE), rows], dim=2)

"""The small networks behind the shipped street models, and the graphs that give their outputs by contract.

Each network returns logits for the loss; its ``...Graph`` wraps it into what the model cards promise (DESIGN, *Model
cards*). Shape suffixes: N pictures, A grid cells of all strides, C classes, K points, E edges, h x w field cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from labeling.model_cards import DETECTOR_STRIDES
from labeling.schemas import keypoint_schema

FIELD_STRIDE = 8
MAX_LOG_SIZE = 5.0
"""Sides of no object are more cells than its exponential."""


def conv_unit(inputs: int, outputs: int, *, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    """Convolution, batch norm and ReLU; with stride 2, output cell i is centred on input pixel 2 i."""
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class ResidualUnit(nn.Module):
    """Two 3x3 convolutions around a shortcut (He et al. 2016); between them ``waist`` channels."""

    def __init__(self, width: int, waist: int) -> None:
        super().__init__()
        self.first = conv_unit(width, waist)
        self.second = nn.Sequential(nn.Conv2d(waist, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(N, width, h, w) to the same shape."""
        return functional.relu(x + self.second(self.first(x)))


class Trunk(nn.Module):
    """A stem at stride 4, then stages at strides 8, 16, ...: each halves the picture, then refines it.

    The stem is one large convolution: at stride 2, moving memory costs more than the products. Cell i of any stage is
    centred on input pixel i * stride. ``waists`` are those of each stage's residual units, by default its width.
    """

    def __init__(self, widths: Sequence[int], depths: Sequence[int], waists: Sequence[int] | None = None) -> None:
        super().__init__()
        self.stem = conv_unit(3, widths[0], stride=4, kernel=7)
        stages = []
        waists = waists or widths[1:]
        for inputs, width, depth, waist in zip(widths[:-1], widths[1:], depths, waists, strict=True):
            units = [conv_unit(inputs, width, stride=2), *(ResidualUnit(width, waist) for _ in range(depth))]
            stages.append(nn.Sequential(*units))
        self.stages = nn.ModuleList(stages)

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Features of every stage, finest first."""
        return self.refine(self.stem(x))

    def refine(self, x: torch.Tensor) -> list[torch.Tensor]:
        """As ``forward``, from what the stem made of a picture."""
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


class Pyramid(nn.Module):
    """Coarse features handed down to finer ones (Lin et al. 2017), all of one width."""

    def __init__(self, inputs: Sequence[int], width: int) -> None:
        super().__init__()
        self.laterals = nn.ModuleList(conv_unit(size, width, kernel=1) for size in inputs)
        self.smooth = nn.ModuleList(conv_unit(width, width) for _ in inputs[:-1])

    def forward(self, features: list[torch.Tensor]) -> list[torch.Tensor]:
        """One feature map of the pyramid's width per input, finest first."""
        merged = [self.laterals[-1](features[-1])]
        for index in range(len(features) - 2, -1, -1):
            fine = self.laterals[index](features[index])
            coarse = functional.interpolate(merged[0], scale_factor=2.0, mode="nearest")
            # Where a side is no multiple of the coarse stride, its map overhangs by one cell.
            merged.insert(0, self.smooth[index](fine + coarse[..., : fine.shape[-2], : fine.shape[-1]]))
        return merged


class StreetDetector(nn.Module):
    """A YOLOX-like detector: one prediction per cell of strides 8, 16 and 32, one head shared by all of them.

    A last stage at stride 64 predicts nothing: it sees both ends of a near car, which would else be found twice. Most
    of the time goes to stride 8, so that by default nothing but the pyramid works there (``towers``: which strides have
    a convolution of their own before the head).
    """

    def __init__(
        self,
        classes: int,
        *,
        widths: Sequence[int] = (32, 48, 80, 112, 128),
        depths: Sequence[int] = (1, 2, 2, 1),
        waists: Sequence[int] | None = None,
        width: int = 48,
        towers: Sequence[bool] = (False, True, True),
    ) -> None:
        super().__init__()
        self.fine_channels = widths[0]
        self.trunk = Trunk(widths, depths, waists)
        self.pyramid = Pyramid(widths[1:], width)
        self.tower = nn.ModuleList(conv_unit(width, width) if built else nn.Identity() for built in towers)
        self.head = nn.Conv2d(width, 5 + classes, 1)
        # A cell holds an object about once in a hundred (Lin et al. 2017, focal loss).
        nn.init.constant_(self.head.bias[4:5], -4.6)  # type: ignore[index]

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """(N, 3, H, W) normalised BGR to (N, A, 5 + C): offset x, y, log size w, h, then logits."""
        return self.look(pictures).rows

    def look(self, pictures: torch.Tensor) -> "FirstLook":
        """As ``forward``, with the features that led there."""
        fine = self.trunk.stem(pictures)
        levels = self.pyramid(self.trunk.refine(fine))[: len(DETECTOR_STRIDES)]
        towers = [tower(x) for tower, x in zip(self.tower, levels, strict=True)]
        return FirstLook(
            rows=_by_cell([self.head(x) for x in towers]).transpose(1, 2), cell_features=_by_cell(towers), fine=fine,
            coarse=levels[0],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FirstLook:
    """What a detector makes of pictures."""

    rows: torch.Tensor
    """(N, A, 5 + C) as ``StreetDetector`` gives them."""
    cell_features: torch.Tensor
    """(N, width, A) from which each row is read."""
    fine: torch.Tensor
    """(N, widths[0], H / 4, W / 4)."""
    coarse: torch.Tensor
    """(N, width, H / 8, W / 8): the pyramid's finest level."""


def _by_cell(levels: list[torch.Tensor]) -> torch.Tensor:
    """(N, D, A) cells of all strides from their maps (N, D, h, w)."""
    return torch.cat([level.flatten(2) for level in levels], dim=2)


class DetectorGraph(nn.Module):
    """``StreetDetector`` as the ``yolox`` contract wants it: probabilities for objectness and classes."""

    def __init__(self, network: StreetDetector) -> None:
        super().__init__()
        self.network = network

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """``output`` (N, A, 5 + C)."""
        rows = self.network(pictures)
        return torch.cat([rows[..., :2], rows[..., 2:4].clamp(max=MAX_LOG_SIZE), rows[..., 4:].sigmoid()], dim=2)


class SimccNetwork(nn.Module):
    """Top-down keypoints by coordinate classification (SimCC, Li et al. 2022), with a visibility per point.

    Args:
        schema: keypoint schema, K points.
        size: input width and height; each a multiple of 16, or of 32 with four widths.
        widths: channels at strides 4, 8 and 16, and perhaps 32, which sees the whole crop: left and right are not told
            apart by what is near a point.
    """

    def __init__(self, schema: str, size: tuple[int, int], *, widths: Sequence[int] = (32, 56, 88)) -> None:
        super().__init__()
        points = keypoint_schema(schema).point_count
        cells = (size[0] // 8) * (size[1] // 8)
        self.trunk = Trunk(widths, (2, 2, 1)[: len(widths) - 1])
        self.pyramid = Pyramid(widths[1:], widths[1])
        self.points = nn.Conv2d(widths[1], points, 1)
        self.along_x = nn.Linear(cells, 2 * size[0])
        self.along_y = nn.Linear(cells, 2 * size[1])
        self.seen_locally = nn.Linear(cells, 1)
        self.seen_globally = nn.Linear(widths[-1], points)

    def forward(self, crops: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(N, 3, H, W) normalised RGB to logits (N, K, 2 W), (N, K, 2 H) and visibility logits (N, K)."""
        features = self.trunk(crops)
        maps = self.points(self.pyramid(features)[0]).flatten(2)
        seen = self.seen_locally(maps).squeeze(2) + self.seen_globally(features[-1].mean((2, 3)))
        return self.along_x(maps), self.along_y(maps), seen


class SimccGraph(nn.Module):
    """``SimccNetwork`` as the ``simcc`` contract wants it: both maxima are the probability that the point is seen.

    Args:
        network: trained.
        shift: added to the logits of that probability.
    """

    def __init__(self, network: SimccNetwork, *, shift: float = 0.0) -> None:
        super().__init__()
        self.network, self.shift = network, shift

    def forward(self, crops: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``simcc_x`` (N, K, 2 W) and ``simcc_y`` (N, K, 2 H), each at most the visibility, which its maximum is."""
        along_x, along_y, seen = self.network(crops)
        visible = (seen + self.shift).sigmoid().unsqueeze(2)
        return visible * _peak_one(along_x), visible * _peak_one(along_y)


def _peak_one(logits: torch.Tensor) -> torch.Tensor:
    return (logits - logits.amax(dim=2, keepdim=True)).exp()


class FieldNetwork(nn.Module):
    """Composite intensity and association fields at stride 8 for one or more schemas (Kreiss et al. 2019).

    The trunk goes down to stride 64: which of its 24 points lies where on a lane, only the whole lane tells.
    """

    def __init__(
        self, schemas: Sequence[str], *, widths: Sequence[int] = (32, 48, 64, 96, 112), width: int = 48
    ) -> None:
        super().__init__()
        self.tables = [keypoint_schema(name) for name in schemas]
        self.trunk = Trunk(widths, (1, 1, 1, 2))
        self.pyramid = Pyramid(widths[1:], width)
        self.cif = nn.ModuleList(nn.Conv2d(width, 4 * table.point_count, 1) for table in self.tables)
        self.caf = nn.ModuleList(nn.Conv2d(width, 7 * len(table.edges), 1) for table in self.tables)
        for head, channels in [(head, 4) for head in self.cif] + [(head, 7) for head in self.caf]:
            nn.init.constant_(head.bias[::channels], -4.6)  # type: ignore[index]

    def forward(self, pictures: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Per schema, from (N, 3, H, W) normalised RGB:

        cif (N, K, 4, h, w): confidence logit, x and y offset in cells, log scale;
        caf (N, E, 7, h, w): confidence logit, both ends' x and y offsets in cells, both log scales.
        """
        x = self.pyramid(self.trunk(pictures))[0]
        return [
            (cif(x).unflatten(1, (table.point_count, 4)), caf(x).unflatten(1, (len(table.edges), 7)))
            for cif, caf, table in zip(self.cif, self.caf, self.tables, strict=True)
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sharpening:
    """What is done to one schema's fields for the decoder, which adds and multiplies confidences up."""

    gain: float = 1.0
    """Of the confidences' logits."""
    shift: float = 0.0
    """Added to them."""
    widen: float = 1.0
    """Of the points' scales."""


class FieldGraph(nn.Module):
    """``FieldNetwork`` as the ``cifcaf`` contract wants it, for a fixed field size; one ``Sharpening`` per schema."""

    offsets: torch.Tensor

    def __init__(self, network: FieldNetwork, *, columns: int, rows: int, sharpen: Sequence[Sharpening]) -> None:
        super().__init__()
        self.network, self.sharpen = network, tuple(sharpen)
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        self.register_buffer("offsets", torch.stack([x, y]).float()[None, None])

    def forward(self, pictures: torch.Tensor) -> list[torch.Tensor]:
        """``cif`` (N, K, 5, h, w) and ``caf`` (N, E, 8, h, w), one pair after the other; units are cells."""
        outputs = []
        for (cif, caf), one in zip(self.network(pictures), self.sharpen, strict=True):
            for field, ends in ((cif, 1), (caf, 2)):
                confidence = (one.gain * field[:, :, :1] + one.shift).sigmoid()
                places = [field[:, :, 1 + 2 * end : 3 + 2 * end] + self.offsets for end in range(ends)]
                scale = one.widen * field[:, :, 1 + 2 * ends :].clamp(max=MAX_LOG_SIZE).exp()
                outputs.append(torch.cat([confidence * 0, confidence, *places, scale], dim=2))
        return outputs

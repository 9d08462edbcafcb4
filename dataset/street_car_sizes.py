"""What the street's cars measure and which colours they come in: five body shapes."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

CarShape = Literal["sedan", "hatch", "suv", "van", "coupe"]
CAR_SHAPES: tuple[CarShape, ...] = ("sedan", "hatch", "suv", "van", "coupe")

CAR_COLOURS = np.array(
    [
        (176, 30, 34), (28, 60, 130), (228, 230, 232), (34, 36, 40), (132, 138, 144), (64, 70, 78), (190, 194, 198),
        (22, 84, 74), (204, 150, 44), (112, 40, 48), (70, 112, 162), (86, 100, 66), (206, 196, 176), (190, 84, 34),
    ],
    np.float32,
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class CarSize:
    """Measures of a body shape, metres."""

    length: float
    width: float
    height: float
    belt: float
    """Height of the lower edge of the windows."""
    hood: float
    """Height of the bonnet's front edge."""
    screen_base: float
    """x of the windscreen's foot."""
    roof_front: float
    roof_rear: float
    rear_base: float
    """x of the rear window's foot."""
    wheel: float
    """Wheel radius."""


SIZES: dict[CarShape, CarSize] = {
    "sedan": CarSize(length=4.6, width=1.82, height=1.45, belt=0.94, hood=0.76, screen_base=0.95, roof_front=0.25,
                     roof_rear=-0.95, rear_base=-1.55, wheel=0.33),
    "hatch": CarSize(length=3.95, width=1.74, height=1.50, belt=0.93, hood=0.76, screen_base=0.95, roof_front=0.35,
                     roof_rear=-1.45, rear_base=-1.80, wheel=0.31),
    "suv": CarSize(length=4.55, width=1.90, height=1.72, belt=1.10, hood=0.94, screen_base=0.95, roof_front=0.35,
                   roof_rear=-1.80, rear_base=-2.08, wheel=0.37),
    "van": CarSize(length=4.9, width=1.95, height=1.96, belt=1.14, hood=0.94, screen_base=1.55, roof_front=0.95,
                   roof_rear=-2.28, rear_base=-2.36, wheel=0.34),
    "coupe": CarSize(length=4.35, width=1.84, height=1.32, belt=0.88, hood=0.68, screen_base=0.75, roof_front=0.0,
                     roof_rear=-0.75, rear_base=-1.60, wheel=0.34),
}  # fmt: skip

"""The attribute table of the stream (spec 3.2): names and channels, as both sides use them.

Facts only: quantization is the encoder's, dequantization the native module's.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_VALUE = 1 << 24  # integers of channels and trajectories stay within +-MAX_VALUE (spec 6.5)
GRID_BITS_MAX = 21  # bits of a position per axis (spec 4)
NEIGHBORS_MAX = 8  # nodes that one Gaussian may blend (spec 4)


@dataclass(frozen=True)
class Attribute:
    """One attribute of a Gaussian.

    Attributes:
        name: as in `Gaussians`.
        number: in the stream.
        channels: integers per Gaussian; of shN for one coefficient.
        meaning: of the integers, once dequantized.
    """

    name: str
    number: int
    channels: int
    meaning: str


ATTRIBUTES = (
    Attribute("means", 1, 3, "x, y, z; canonical on the grid"),
    Attribute("log_scales", 2, 3, "natural log of the standard deviations, world units"),
    Attribute("quats", 3, 3, "x, y, z of the unit quaternion, w = sqrt(1 - x^2 - y^2 - z^2)"),
    Attribute("logit_opacities", 4, 1, "logit of the opacity"),
    Attribute("sh0", 5, 3, "Y, Co, Cg of the Y_00 coefficient"),
    Attribute("shN", 6, 3, "Y, Co, Cg per coefficient of the higher bands"),
)
BY_NAME = {a.name: a for a in ATTRIBUTES}


def channels(name: str, sh_degree: int) -> int:
    """Integers per Gaussian of attribute `name` in a group of `sh_degree` 0 to 3."""
    per = BY_NAME[name].channels
    return per * ((sh_degree + 1) ** 2 - 1) if name == "shN" else per

"""The attribute table: everything that differs between the attributes of a Gaussian, declared once.

Training, quantization and the stream read it; gsv::attributes mirrors the columns that the stream knows (spec 3.2), and
a test compares the two. A new attribute needs one row here, one row there, and the code that is specific to it.
"""

from __future__ import annotations

from dataclasses import dataclass

GRID_BITS_MAX = 21  # bits of a position per axis (spec 4)
NEIGHBORS_MAX = 8  # nodes that one Gaussian may blend (spec 4)
FREQUENCIES_OF = 20  # frames for which `temporal_frequencies` are given; longer groups have more in proportion


@dataclass(frozen=True)
class Attribute:
    """One attribute of a Gaussian.

    Attributes:
        name: as in `Gaussians`.
        number: of the attribute in the stream.
        channels: integers per Gaussian; shN: per coefficient.
        meaning: of the dequantized integers.
        decorrelated: RGB triples are coded as Y, Co, Cg (spec 13.5).
        companded: values may be coded along a curve (spec 13.1).
        nominal_step: quantization step at quality 50 (means: radii of the subject); equal slopes of rendered error
            against bits, measured on a scanned statue.
        coarsest_step: beyond it the derivative of the image does not predict the error (means: radii of the subject).
        temporal_frequencies: of its trajectory in a group of `FREQUENCIES_OF` frames; 0: constant in a group.
        learning_rate: of Adam in a keyframe, at the first step (means: radii of the subject).
    """

    name: str
    number: int
    channels: int
    meaning: str
    decorrelated: bool = False
    companded: bool = False
    nominal_step: float = 0.0
    coarsest_step: float = 0.0
    temporal_frequencies: int = 0
    learning_rate: float = 0.0


ATTRIBUTES = (
    Attribute(
        "means", 1, 3, "x, y, z; canonical on the grid",
        nominal_step=0.001, coarsest_step=0.02, temporal_frequencies=10, learning_rate=1.6e-3,
    ),
    Attribute(
        "log_scales", 2, 3, "natural log of the standard deviations, world units", companded=True,
        nominal_step=0.25, coarsest_step=1.0, temporal_frequencies=3, learning_rate=8e-2,
    ),
    Attribute(
        "quats", 3, 3, "x, y, z of the unit quaternion, w = sqrt(1 - x^2 - y^2 - z^2)",
        nominal_step=0.035, coarsest_step=0.25, temporal_frequencies=4, learning_rate=1.6e-2,
    ),
    Attribute(
        "logit_opacities", 4, 1, "logit of the opacity", companded=True,
        nominal_step=0.63, coarsest_step=2.0, temporal_frequencies=3, learning_rate=3e-2,
    ),
    Attribute(
        "sh0", 5, 3, "Y, Co, Cg of the Y_00 coefficient", decorrelated=True,
        nominal_step=0.125, coarsest_step=1.0, temporal_frequencies=6, learning_rate=5e-3,
    ),
    Attribute(
        "shN", 6, 3, "Y, Co, Cg per coefficient of the higher bands", decorrelated=True,
        nominal_step=0.125, coarsest_step=1.0, learning_rate=1.5e-3,
    ),
)  # fmt: skip
BY_NAME = {a.name: a for a in ATTRIBUTES}
CANONICAL = tuple(a.name for a in ATTRIBUTES if a.name != "means")  # coded in channels; means are points on the grid
COMPANDED = tuple(a.name for a in ATTRIBUTES if a.companded)

"""Settings of recolouring: colours fitted to pictures over the geometry of a stream."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class RecolorSettings:
    """Fit of colours (`train/recolor.py`).

    Attributes:
        passes: times that each training picture of a frame is used.
        frame_pictures: pictures of a frame at most.
        steps_least: steps of a group at least, however short it is.
        map_pictures: number of pictures for the affine map of all colours.
        opaque: alpha above which a pixel counts for the map.
        pixels_least: with fewer pixels the map is left out.
        prior: weight of the identity map, per pixel.
        rates: learning rates of the harmonics at the first step.
        over_time: learning rates of coefficients, times `rates`.
        frequencies: temporal frequencies of sh0 in a group, with the constant, if the stream has no more.
    """

    passes: int = 4
    frame_pictures: int = 40
    steps_least: int = 200
    map_pictures: int = 24
    opaque: float = 0.95
    pixels_least: int = 100
    prior: float = 1e-4
    rates: dict[str, float] = field(default_factory=lambda: {"sh0": 0.02, "shN": 0.004})
    over_time: float = 0.25
    frequencies: int = 3

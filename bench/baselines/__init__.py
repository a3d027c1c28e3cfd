"""Other codecs, each in a short file after its public description, with the settings that its users choose.

A baseline codes the frames of one group into named files, which hold all that decoding needs. Each module has
SETTINGS (name -> arguments of encode), encode(frames, ...) -> files and decode(files) -> frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType

from gscodec.model.gaussians import Gaussians

from . import draco, gpcc, gsav, sog, spz, svt_av1, videogs, webp, x265_anchor, zstd
from .maps import order_of


@dataclass(frozen=True)
class Baseline:
    """One codec of the comparison.

    Attributes:
        module: has encode and decode.
        settings: name of a point of the curve -> arguments of encode.
        prepare: from the first frame of a group, computes and caches the part that is equal for all settings.
        per_frame: each frame is coded alone, so that only the measured frames need to be coded.
    """

    module: ModuleType
    settings: dict[str, dict]
    prepare: Callable[[Gaussians], object] = lambda g: None
    per_frame: bool = False

    @property
    def encode(self) -> Callable[..., dict[str, bytes]]:
        return self.module.encode

    @property
    def decode(self) -> Callable[[dict[str, bytes]], Sequence[Gaussians]]:
        return self.module.decode


BASELINES = {
    "videogs": Baseline(videogs, videogs.SETTINGS),
    "videogs-raw": Baseline(videogs, videogs.RAW_SETTINGS),
    "x265": Baseline(x265_anchor, x265_anchor.SETTINGS, order_of),
    "svt-av1": Baseline(svt_av1, svt_av1.SETTINGS, order_of),
    "gsav": Baseline(gsav, gsav.SETTINGS),
    "webp": Baseline(webp, webp.SETTINGS, order_of),
    "zstd": Baseline(zstd, zstd.SETTINGS),
    "draco": Baseline(draco, draco.SETTINGS, per_frame=True),
    "gpcc": Baseline(gpcc, gpcc.SETTINGS, per_frame=True),
    "sog": Baseline(sog, sog.SETTINGS, per_frame=True),
    "spz": Baseline(spz, spz.SETTINGS, per_frame=True),
}

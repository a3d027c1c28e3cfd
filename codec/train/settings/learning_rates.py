"""Learning rates by attribute."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LearningRates:
    """Learning rate of each attribute of the Gaussians."""

    means: float  # radii
    quats: float
    log_scales: float
    logit_opacities: float
    sh0: float
    shN: float

    def scaled(self, radius: float, factor: float = 1.0) -> dict[str, float]:
        """Rates by attribute, times `factor`; `radius` in world units."""
        return {name: rate * factor for name, rate in {**vars(self), "means": self.means * radius}.items()}

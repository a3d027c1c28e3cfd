"""Learning rates by attribute."""

from __future__ import annotations

from dataclasses import dataclass

from ...model.attributes import ATTRIBUTES


@dataclass(frozen=True)
class LearningRates:
    """Learning rate of each attribute of the Gaussians.

    Attributes:
        by_attribute: attribute -> rate; means in radii of the subject.
    """

    by_attribute: dict[str, float]

    def __getitem__(self, attribute: str) -> float:
        return self.by_attribute[attribute]

    def but(self, **rates: float) -> LearningRates:
        """The same rates, but for those of some attributes."""
        return LearningRates(self.by_attribute | rates)

    def scaled(self, radius: float, factor: float = 1.0) -> dict[str, float]:
        """Rates by attribute, times `factor`; `radius` in world units."""
        return {n: rate * factor * (radius if n == "means" else 1.0) for n, rate in self.by_attribute.items()}


def keyframe_rates() -> LearningRates:
    """Rates of the attribute table, for the first step of a keyframe."""
    return LearningRates({a.name: a.learning_rate for a in ATTRIBUTES})

"""Foreign splats -> ParametricGroup: nodes and trajectories. The counterpart of train/ for what others trained."""

from .fit import fit_groups

__all__ = ["fit_groups"]

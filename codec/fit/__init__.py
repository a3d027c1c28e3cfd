"""Splats of other tools -> ParametricGroup: nodes and trajectories. The counterpart of train/ for them."""

from .fit import fit_groups

__all__ = ["fit_groups"]

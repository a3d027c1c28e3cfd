"""Gaussians + Camera -> image, on the CPU, differentiable.

`image` (numpy) is the player's side; `rasterize` and `reference` need torch; `step` is the whole image side of a
training step in one native call.
"""

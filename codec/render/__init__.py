"""Gaussians + Camera -> image, on the CPU, differentiable.

`image` is for the player. `backend` is the interface for training, `cpu` its implementation, `optimizer` Adam along the
gradients, `sensitivity` the measurement for encoding. `reference` is the slow plain version (torch).
"""

"""Gaussians + Camera -> image, on the CPU, differentiable.

`image` is the player's side. `backend` is the seam that training goes through, `cpu` its implementation, `optimizer`
what steps along the gradients, `sensitivity` what encoding measures. `reference` is the slow plain version (torch).
"""

"""Refinement of a single frame: integers move to where the picture is nearest to the source, given all other integers.

Rounding each channel on its own leaves errors that a neighbour could make up for. Views that no step has seen before
are drawn of source and decoded frame; the gradient of their squared difference moves what lies under the integers, and
passes straight through the rounding (Bengio et al. 2013). Positions stay: they give the order. So do rotations, each of
which is coded as a turn from another.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gscodec.bitstream.color import TO_RGB
from gscodec.camera import Camera
from gscodec.gaussians import Gaussians
from gscodec.render.sensitivity import GREY, arrays_of, derivatives, sensitivity_cameras
from gscodec.render.workspace import Workspace

RATE = 0.01  # quantization steps a step, at first
BETAS, EPS = (0.9, 0.99), 1e-30
INSIDE = 0.02  # quantization steps: so far from where it would change, at least, starts what is under an integer


def refine(
    source: Gaussians,
    shown: Gaussians,
    latents: dict[str, np.ndarray],
    integers: dict[str, np.ndarray],
    margins: dict[str, tuple[np.ndarray, np.ndarray]],
    decode: Callable[[dict], tuple[dict, dict]],
    *,
    steps: int,
    cameras: list[Camera] = (),
) -> dict[str, np.ndarray]:
    """Better integers: attribute -> [N, C] i32.

    Args:
        source: N Gaussians, as they are to look. shown: what stays of those that are shown.
        latents: attribute -> [N, C], what was quantized, in quantization steps of each Gaussian.
        integers: attribute -> [N, C], what it was quantized to.
        margins: attribute -> [N, C] each, of `rdo.margins`.
        decode: integers -> values, and how much they change with an integer; attribute -> [N, C] each.
        steps: views that are looked at. cameras: those of the capture.
    """
    workspace, x = Workspace(), {}
    for n, q in integers.items():
        up, down = margins[n]
        x[n] = np.clip(latents[n], q - 0.5 - down + INSIDE, q + 0.5 + up - INSIDE).astype(np.float32)

    def rounded():
        above = {n: x[n] - q > 0.5 + margins[n][0] for n, q in integers.items()}
        below = {n: q - x[n] > 0.5 + margins[n][1] for n, q in integers.items()}
        return {n: q + above[n] - below[n] for n, q in integers.items()}

    first, second = ({n: np.zeros_like(v) for n, v in x.items()} for _ in range(2))
    views, original = sensitivity_cameras(source.means, cameras, steps), arrays_of(source)
    for step, i in enumerate(np.random.default_rng(0).permutation(len(views)), 1):
        camera = views[i]
        target, _ = workspace.forward(original, camera, GREY)
        values, slopes = decode(rounded())
        off = lambda image, target=target: np.ascontiguousarray(image - target)  # noqa: E731
        derivative = derivatives(workspace, _frame(shown, values), camera, off)
        rate = RATE * (1 - (step - 1) / len(views))
        for n, v in x.items():
            d = derivative[n] * slopes[n]
            first[n] += (1 - BETAS[0]) * (d - first[n])
            second[n] += (1 - BETAS[1]) * (d * d - second[n])
            size = np.sqrt(second[n] / (1 - BETAS[1] ** step)) + EPS
            v -= rate * first[n] / (1 - BETAS[0] ** step) / size
    return {n: q.astype(np.int32) for n, q in rounded().items()}


def _frame(shown: Gaussians, values: dict[str, np.ndarray]) -> Gaussians:
    shN = values.get("shN", np.zeros((len(shown), 0))).reshape(len(shown), -1, 3) @ TO_RGB.T
    colors = values["sh0"] @ TO_RGB.T
    return Gaussians(shown.means, shown.quats, values["log_scales"], values["logit_opacities"][:, 0], colors, shN)

"""Sensitivity: d(mean squared error of the rendered views) / d(squared error of a parameter), per Gaussian; and the
quantization steps that follow from it.

If the parameters carry independent errors e, the mean squared error of the image is the sum of W * e^2, where W is the
mean over pixels and views of the squared derivative. A backward pass whose pixel gradients are random signs estimates
all W at once, without bias (Hutchinson's estimator of a diagonal). The views stand on a sphere around the subject; they
are not those of `gscodec eval`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from ..bitstream.channels import channel_values
from ..bitstream.color import STEP_WEIGHTS, TO_RGB
from ..bitstream.quantization import Steps, error_for, subject_radius
from ..model.attributes import BY_NAME
from ..model.camera import Camera, cameras_around, low_pass_of
from ..model.gaussians import PARAMETERS, SH_C0, Gaussians
from .backend import TURNS, Backend
from .cpu import CpuBackend

VIEWS, SIZE = 24, 512
GREY = (0.5, 0.5, 0.5)
DARKEST = 1e-3  # colour, in 0..1, at which the derivative of black is taken


@dataclass(frozen=True)
class Importance:
    """Sensitivities in the units of the coded channels; pixels are 0 to 1.

    Attributes:
        weights: attribute -> [N, C] f64, W of each channel. quats: W of rotations about the Gaussian's own axes (vector
            part of a quaternion that is multiplied from the right).
        scene_rotations: [N, 3] f64, W of rotations about the axes of the scene (multiplied from the left).
        removal: [N] f64, mean squared error of the image without this Gaussian.
    """

    weights: dict[str, np.ndarray]
    scene_rotations: np.ndarray
    removal: np.ndarray

    def take(self, index: np.ndarray) -> Importance:
        """The Gaussians at `index`."""
        weights = {n: w[index] for n, w in self.weights.items()}
        return Importance(weights, self.scene_rotations[index], self.removal[index])

    def with_weights(self, **weights: np.ndarray) -> Importance:
        """This importance with other sensitivities of some attributes."""
        return replace(self, weights=self.weights | weights)

    def at_least(self, other: Importance, share: float, among: np.ndarray) -> Importance:
        """This importance, for the Gaussians `among` ([N] bool) at least `share` times `other`."""
        some = among[:, None]
        weights = {n: np.where(some, np.maximum(w, share * other.weights[n]), w) for n, w in self.weights.items()}
        turns = np.where(some, np.maximum(self.scene_rotations, share * other.scene_rotations), self.scene_rotations)
        removal = np.where(among, np.maximum(self.removal, share * other.removal), self.removal)
        return Importance(weights, turns, removal)

    def with_axes(self, order: np.ndarray) -> Importance:
        """This importance for Gaussians whose own axes are in `order` ([N, 3] int)."""
        own = {n: np.take_along_axis(self.weights[n], order, 1) for n in ("log_scales", "quats")}
        return self.with_weights(**own)


def sensitivity_cameras(means: np.ndarray, given: list[Camera] = (), count: int = VIEWS) -> list[Camera]:
    """`count` cameras on a Fibonacci sphere around the 1-99 % box of `means`, every other one at half the distance.

    Args:
        given: cameras of the capture; they replace up to half of the others, since they may stand within the scene.
    """
    taken = [given[i] for i in np.linspace(0, len(given) - 1, min(len(given), count // 2)).round().astype(int)]
    fitted = [of_width(c, SIZE) for c in taken]
    left = count - len(taken)
    return fitted + cameras_around(means, left, name="sensitivity", turn=1.3, low_pass=low_pass_of(given))


def of_width(camera: Camera, width: int) -> Camera:
    """The camera with images of `width` pixels."""
    return camera.resized(width, max(1, round(width * camera.height / camera.width)))


def measure(shown: Callable[[int], Gaussians], cameras: list[Camera], *, backend: Backend | None = None) -> Importance:
    """Sensitivity over several frames of the same N >= 1 Gaussians.

    Args:
        shown: index of a view -> the Gaussians that it shows.
        cameras: one for each view, all frames together.
        backend: a new CpuBackend if None.
    """
    signs = np.random.default_rng(0)
    backend = backend or CpuBackend()
    total, removal = {}, 0.0
    for i, camera in enumerate(cameras):
        g = _above_black(shown(i))
        probe = (2.0 * signs.integers(0, 2, (camera.height, camera.width, 3)) - 1).astype(np.float32)
        share = 1 / (len(cameras) * probe.size)
        for name, d in derivatives(backend, g, camera, lambda _, probe=probe: probe).items():
            total[name] = total.get(name, 0) + share * d * d
            if name == "logit_opacities":
                transparency = np.maximum(1 / (1 + np.exp(g.logit_opacities)), 1e-6)
                removal += share * (d[:, 0] / transparency) ** 2
    total = {n: w.astype(np.float64) for n, w in total.items()}
    return Importance(total, total.pop("scene_rotations"), removal)


def _above_black(g: Gaussians) -> Gaussians:
    """`g` with its darkest colours a little brighter: at black the rasterizer clamps, and the derivative says nothing
    about a step up."""
    return replace(g, sh0=np.maximum(g.sh0, np.float32((DARKEST - 0.5) / SH_C0)))


def params_of(g: Gaussians, turns: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The arrays of `g` by name, as a backend takes them; `turns`: rotations [N, 4] of its SH."""
    params = {name: np.ascontiguousarray(getattr(g, name), np.float32) for name in PARAMETERS}
    return params if turns is None else {**params, TURNS: turns}


def arrays_of(g: Gaussians) -> tuple[np.ndarray, ...]:
    """The arrays of `g` in the order of PARAMETERS, as a workspace takes them."""
    return tuple(params_of(g).values())


def derivatives(
    backend: Backend,
    g: Gaussians,
    camera: Camera,
    by_picture: Callable[[np.ndarray], np.ndarray],
    names: Iterable[str] = (*BY_NAME, "scene_rotations"),
    background: tuple[float, ...] = GREY,
    turns: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Derivatives by the coded channels, attribute -> [N, C].

    Args:
        by_picture: image of `camera` over `background` -> derivative by its pixels, [H, W, 3] f32 both.
        names: attributes; quats by rotations about the Gaussian's own axes, "scene_rotations" about those of the scene.
            shN is left out where there is none.
        turns: rotations [N, 4] of the SH of `g`; None: SH is not rotated.
    """
    by_pixels = lambda image, alpha: (by_picture(image), np.zeros_like(alpha))  # noqa: E731
    grads = backend.backpropagate(params_of(g, turns), camera, background, by_pixels)
    return {n: _by_channels(g, grads, n) for n in names if n != "shN" or g.sh_degree}


def _by_channels(g: Gaussians, grads: dict, name: str) -> np.ndarray:
    """[N, C] derivatives by the coded channels, from those by the parameters."""
    if name in ("quats", "scene_rotations"):
        w, x, y, z = g.quats.T
        scene = [[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]]  # i q, j q, k q: [3, 4, N]
        own = [[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]]  # q i, q j, q k
        return np.einsum("kcn,nc->nk", np.stack(own if name == "quats" else scene), grads["quats"])
    grad = grads[name]
    if name in ("sh0", "shN"):
        grad = grad @ TO_RGB.astype(np.float32)
    return grad.reshape(len(g), math.prod(grad.shape[1:]))


def steps_for_error(
    weights: dict, values: dict, error: float, radius: float, shifts: dict | None = None
) -> dict[str, np.ndarray]:
    """Steps [C] of each attribute at which the mean squared error of the image is `error`, at the fewest bits.

    Every channel takes the same share of the error, or all of its energy where that is less (reverse water-filling:
    Cover and Thomas, 10.3.3).

    Args:
        weights: of `Importance`.
        values: attribute -> [N, C], to be quantized. All axes of the means have one step.
        error: mean squared, pixels 0 to 1.
        radius: of the subject, world units.
        shifts: attribute -> [N], the steps of a Gaussian are 2^shift times those of the attribute; None: all 0.
    """
    coarser = {n: 1.0 if shifts is None else 4.0 ** shifts[n][:, None] for n in weights}
    sums = {n: np.maximum((w * coarser[n]).sum(0), 1e-30) for n, w in weights.items()}
    sums["means"] = np.full(3, sums["means"].mean())
    energy = np.concatenate([(weights[n] * (v - np.median(v, 0)) ** 2).sum(0) for n, v in values.items()])
    low, high = 0.0, error
    for _ in range(50):
        share = (low + high) / 2
        low, high = (share, high) if np.minimum(share, energy).sum() < error else (low, share)
    return {n: np.minimum(np.sqrt(12 * high / s), coarsest(n, radius)).astype(np.float32) for n, s in sums.items()}


def measured_steps(
    g: Gaussians, quality: float, nominal: Steps, cameras: list[Camera] = (), *, backend: Backend | None = None
) -> Steps:
    """Estimate of the steps that the encoder will choose for a group like `g`: one step for all channels of an
    attribute, at the same rate.

    Args:
        nominal: result where there are no Gaussians.
        cameras: of the capture.
        backend: a new CpuBackend if None.
    """
    if not len(g):
        return nominal
    measured = measure(lambda _: g, sensitivity_cameras(g.means, cameras), backend=backend)
    weights, values = measured.weights | {"quats": measured.scene_rotations}, channel_values(g)
    steps = steps_for_error(weights, {n: values[n] for n in weights}, error_for(quality), subject_radius(g.means))
    for n in (n for n in steps if BY_NAME[n].decorrelated):
        steps[n] /= np.tile(STEP_WEIGHTS, len(steps[n]) // 3)
    mean = {n: float(np.exp(np.log(s).mean())) for n, s in steps.items()}
    return replace(nominal, by_attribute=nominal.by_attribute | mean)


def coarsest(attribute: str, radius: float) -> float:
    """The largest step of an attribute for which its sensitivity predicts the error."""
    return BY_NAME[attribute].coarsest_step * (radius if attribute == "means" else 1.0)

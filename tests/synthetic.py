"""Small Gaussian sequences with known motion, for tests."""

from dataclasses import replace

import numpy as np

from gscodec import _native
from gscodec.encode.coder import GroupCoder
from gscodec.encode.encode import StreamOutput, encode_groups
from gscodec.encode.settings import EncodeSettings
from gscodec.fit import fit_groups
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.model.parametric_group import ParametricGroup
from gscodec.model.rotations import quat_multiply, quat_to_matrix, rotvec_to_quat


def blob(n: int, seed: int = 0, sh_count: int = 0) -> Gaussians:
    """N Gaussians on a unit sphere; scales, rotations and colours vary smoothly and a little at random."""
    r = np.random.default_rng(seed)
    x = r.standard_normal((n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    q = np.concatenate([np.ones((n, 1)), x + 0.2 * r.standard_normal((n, 3))], 1)
    return Gaussians(
        means=x.astype(np.float32),
        quats=(q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32),
        log_scales=(np.log(0.05) + 0.3 * r.standard_normal((n, 3)) - [0, 0, 1.5]).astype(np.float32),
        logit_opacities=(2 + x[:, 0] + r.standard_normal(n)).astype(np.float32),
        sh0=(x + 0.1 * r.standard_normal((n, 3))).astype(np.float32),
        shN=(0.1 * r.standard_normal((n, sh_count, 3))).astype(np.float32),
    )


def moved(g: Gaussians, rotvec: np.ndarray, shift: np.ndarray) -> Gaussians:
    """`g` rotated about the origin and shifted."""
    R = quat_to_matrix(rotvec_to_quat(np.asarray(rotvec, float)))
    q = quat_multiply(np.broadcast_to(rotvec_to_quat(np.asarray(rotvec, float)), g.quats.shape), g.quats.astype(float))
    return Gaussians(
        (g.means @ R.T + shift).astype(np.float32),
        q.astype(np.float32),
        g.log_scales,
        g.logit_opacities,
        g.sh0,
        g.shN,
    )


def turning(n: int = 300, frames: int = 6, sh_count: int = 0, lifetimes: bool = False) -> GaussianSequence:
    """One group: a blob turns 0.1 rad a frame and drifts."""
    g = blob(n, sh_count=sh_count)
    group = [moved(g, np.array([0, 0.1 * t, 0.02 * t]), np.array([0.03 * t, 0, 0])) for t in range(frames)]
    life = None
    if lifetimes:
        life = np.tile(np.array([0, frames], np.int32), (n, 1))
        life[: n // 4, 0] = frames // 2
        life[n // 4 : n // 2, 1] = frames // 2
    return GaussianSequence(25.0, [DenseGroup(group, life)])


def covariances(g: Gaussians) -> np.ndarray:
    """Covariance matrices [N, 3, 3], the same for all (quat, scale) of the same Gaussian."""
    w, x, y, z = g.quats.astype(np.float64).T
    R = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    M = R * np.exp(g.log_scales.astype(np.float64))[:, None, :]
    return M @ M.transpose(0, 2, 1)


def gaussians(n, k=0, seed=0):
    """`n` Gaussians in random order, with `k` harmonics."""
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.normal(size=shape).astype(np.float32)

    quats = normal(n, 4)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return Gaussians(normal(n, 3), quats, normal(n, 3) - 4, 2 * normal(n), normal(n, 3), 0.3 * normal(n, k, 3))


def assert_close(a, b, means=1e-6, log_scales=1e-6, angle=1e-5, opacity=1e-6, sh0=1e-6, shN=1e-6):
    """Compares two sets of Gaussians."""
    np.testing.assert_allclose(b.means, a.means, atol=means)
    np.testing.assert_allclose(b.log_scales, a.log_scales, atol=log_scales)
    np.testing.assert_allclose(np.abs((a.quats * b.quats).sum(1)), 1, atol=angle)
    np.testing.assert_allclose(1 / (1 + np.exp(-b.logit_opacities)), 1 / (1 + np.exp(-a.logit_opacities)), atol=opacity)
    np.testing.assert_allclose(b.sh0, a.sh0, atol=sh0)
    np.testing.assert_allclose(b.shN, a.shN, atol=shN)


def encode_sequence(sequence, path, config, settings=None, turned=False, **options):
    """A dense sequence -> a .gsv file; returns the report. `turned`: the coded harmonics turn with the nodes, even if
    those of the sequence do not. `options` go to StreamOutput (fingerprint)."""
    settings = settings or EncodeSettings(50.0)
    groups = sequence.groups

    def fitted(done, _):
        quality = 50.0 if settings.quality is None else settings.quality
        fitted = fit_groups(groups, start=done, random_access=settings.random_access, quality=quality)
        return (replace(group, turned_harmonics=turned) for group in fitted)

    return encode_groups(fitted, StreamOutput(path, config, **options), settings)


def coded(group: DenseGroup | ParametricGroup, quality: float, *, cameras=(), **settings):
    """One independent group -> CodedGroup and its integers, without refinement by default (`settings`)."""
    coder = GroupCoder(EncodeSettings(**{"refine": 0, "random_access": 0, **settings}), cameras=lambda _: cameras)
    fitted = next(fit_groups([group], quality=quality))
    result, _ = coder.code(None, fitted, coder.measure(fitted, 0), quality, 0)
    return result, _native.DecodedGroup(result.payload, len(_native.levels())).quantized()

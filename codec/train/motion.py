"""Motion of a group: for each frame a smooth field from keyframe positions to translation and rotation.

V3's motion model (Wang et al. 2024): a multi-resolution hash grid and a shallow MLP, here one field a frame on top of
the extrapolated pose of the two frames before, so that it only has to learn the change. The field sees nothing but the
keyframe position (plain and through the grid), hence neighbours move alike; an as-rigid-as-possible term over the
k-NN graph does the rest. In: keyframe model, views. Out: means [T, N, 3] and turns [T, N, 4] of all frames.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gscodec.render.workspace import Workspace
from gscodec.train.hashgrid import HashGrid
from gscodec.train.model import Model
from gscodec.train.settings import TrainSettings
from gscodec.train.views import Views, compare

GRAPH_NEIGHBORS = 6
FIRST_STEPS = 2  # the first frame after a keyframe has no velocity to start from, and takes so many times the steps
LOSS_WINDOW = 20  # steps over which a loss is averaged: about every view once
MLP_RATE, TABLE_RATE, FREE_RATE = 1.2e-2, 4e-2, 5e-3
TRANSLATION_UNIT = 0.1  # of the subject's radius: what an output of 1 means
ROTATION_UNIT = 0.3  # radians


class MotionField(torch.nn.Module):
    """x in the unit cube [N, 3] -> translation [N, 3] in units of the radius and rotation vector [N, 3]."""

    def __init__(self, resolution: int = 64):
        super().__init__()
        self.grid = HashGrid(levels=8, features=2, log2_table=14, base_resolution=4, max_resolution=resolution)
        self.mlp = torch.nn.Sequential(
            torch.nn.Linear(19, 32), torch.nn.ReLU(), torch.nn.Linear(32, 32), torch.nn.ReLU(), torch.nn.Linear(32, 6)
        )
        torch.nn.init.zeros_(self.mlp[-1].weight)
        torch.nn.init.zeros_(self.mlp[-1].bias)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Shapes as the class says; zero for a fresh field."""
        out = self.mlp(torch.cat([self.grid(x), 2 * x - 1], 1))
        return out[:, :3] * TRANSLATION_UNIT, out[:, 3:] * ROTATION_UNIT


def quat_multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product, [N, 4] wxyz."""
    aw, au, bw, bu = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (au * bu).sum(1, keepdim=True)
    return torch.cat([w, aw * bu + bw * au + torch.linalg.cross(au, bu, dim=-1)], 1)


def rotvec_to_quat(v: torch.Tensor) -> torch.Tensor:
    """[N, 3] radians -> [N, 4] wxyz, smooth at zero."""
    half = (v.square().sum(1, keepdim=True) + 1e-16).sqrt() / 2
    return torch.cat([torch.cos(half), v * 0.5 * torch.sinc(half / torch.pi)], 1)


def quat_to_matrix(q: torch.Tensor) -> torch.Tensor:
    """[N, 4] unit wxyz -> [N, 3, 3]."""
    w, x, y, z = q.unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)


class RigidGraph:
    """As-rigid-as-possible over the k-NN graph of the keyframe (Sorkine and Alexa 2007)."""

    def __init__(self, means: torch.Tensor, radius: float):
        from scipy.spatial import cKDTree

        x = means.numpy()
        n, k = len(x), min(GRAPH_NEIGHBORS, len(x) - 1)
        distance, index = cKDTree(x).query(x, k + 1) if k > 0 else (np.ones((n, 1)), np.zeros((n, 1)))
        self.count = k
        self.j = torch.from_numpy(index[:, 1:].astype(np.int64).ravel())
        self.edge = (means[self.j].view(n, k, 3) - means[:, None]).contiguous()
        # Far pairs (bridges across a gap) hold less: half at twice the median distance.
        d = torch.from_numpy(distance[:, 1:].astype(np.float32))
        middle = d.median().clamp(min=1e-12) if k > 0 else torch.ones(())
        self.weight = torch.exp2(-((d / (2 * middle)) ** 2))[..., None] / radius

    def loss(self, means: torch.Tensor, turned: torch.Tensor) -> torch.Tensor:
        """Mean weighted length by which edges miss their rotated selves; `turned` [N, 4] unit, from the keyframe."""
        if self.count == 0:
            return means.sum() * 0
        rotated = torch.bmm(self.edge, quat_to_matrix(turned).transpose(1, 2))
        moved = means.index_select(0, self.j).view_as(rotated) - means[:, None]
        return (self.weight * (moved - rotated)).square().sum(2).add(1e-12).sqrt().mean()


def track(
    key: Model,
    views: Views,
    frames: range,
    settings: TrainSettings,
    *,
    radius: float,
    loss_max: float = float("inf"),
    on_step: Callable[[int, int, float], None] | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses of the keyframe's Gaussians in `frames` (the first one is the keyframe).

    Args:
        loss_max: a frame that ends with a larger image loss is where the keyframe no longer serves: tracking stops
            before it.
        on_step: called with (frame, step, loss).

    Returns:
        means [T, N, 3] and turned [T, N, 4], the rotation of each Gaussian since the keyframe; T <= len(frames).
    """
    x0 = key.params["means"]
    low, high = x0.min(0).values, x0.max(0).values
    unit = ((x0 - low) / (high - low).max().clamp(min=1e-9)).clamp(0, 1)
    means, turned = [x0.clone()], [torch.tensor([1.0, 0, 0, 0]).repeat(len(x0), 1)]
    graph = RigidGraph(x0, radius)
    for number, frame in enumerate(frames[1:], 1):
        base, base_turned = means[-1], turned[-1]
        if number > 1:  # constant velocity
            base = 2 * means[-1] - means[-2]
            back = turned[-2] * torch.tensor([1.0, -1, -1, -1])
            base_turned = quat_multiply(quat_multiply(turned[-1], back), turned[-1])
        start = (unit, base, base_turned)
        pose, loss = _fit_frame(key, views, frame, settings, radius, start, graph, on_step, number == 1)
        if loss > loss_max:
            break
        means.append(pose[0])
        turned.append(pose[1])
    return torch.stack(means), torch.stack(turned)


def _fit_frame(key, views, frame, settings, radius, start, graph, on_step, start_is_keyframe):
    """Pose of one frame (extrapolated + field + what each Gaussian adds on its own) and the loss it ends with."""
    unit, base, base_turned = start
    torch.manual_seed(settings.seed * 1000003 + frame)
    rng = np.random.default_rng([settings.seed, frame, 1])
    field, workspace = MotionField(), Workspace()
    free = torch.zeros(len(unit), 6, requires_grad=True)
    groups = [(field.mlp.parameters(), MLP_RATE), (field.grid.parameters(), TABLE_RATE), ([free], FREE_RATE)]
    optimizer = torch.optim.Adam(
        [{"params": list(p), "lr": r, "base": r} for p, r in groups], betas=(0.9, 0.99), fused=True
    )

    def pose() -> tuple[torch.Tensor, torch.Tensor]:
        move, turn = field(unit)
        turn = rotvec_to_quat(turn + ROTATION_UNIT * free[:, 3:])
        means = base + radius * (move + TRANSLATION_UNIT * free[:, :3])
        return means, torch.nn.functional.normalize(quat_multiply(turn, base_turned), dim=1)

    steps, losses = settings.motion_steps * (FIRST_STEPS if start_is_keyframe else 1), []
    for step in range(steps):
        for g in optimizer.param_groups:
            g["lr"] = g["base"] * 0.1 ** (step / steps)
        means, turned = pose()
        quats = quat_multiply(turned, key.params["quats"])
        params = {**key.params, "means": means, "quats": quats}
        result = compare(params, views.draw(frame), settings, rng, workspace)
        rigid = settings.rigidity * graph.loss(means, turned)
        optimizer.zero_grad()
        torch.autograd.backward([means, quats, rigid], [result.grads["means"], result.grads["quats"], torch.ones(())])
        optimizer.step()
        losses.append(result.loss)
        if on_step:
            on_step(frame, step, result.loss)
    with torch.no_grad():
        return pose(), float(np.mean(losses[-LOSS_WINDOW:]))

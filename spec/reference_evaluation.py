"""Clause 13 of gsv.md for the reference decoder: the integers of a group -> frame t in float64.

In: a Group of reference_group.py, which takes the rotations of births (clause 13.1) from here. Out: the attributes of
all Gaussians, and a mask of those that are shown.
"""

import numpy as np
from reference_units import LOG_SCALES, LOGIT_OPACITIES, MEANS, QUATS, SH0, SHN, channel_count


def basis(coefficients, frames, t):
    """Clause 13.1: [K], orthonormal DCT-II."""
    k = np.arange(coefficients)
    return np.sqrt(np.where(k == 0, 1, 2) / frames) * np.cos(np.pi * (2 * t + 1) * k / (2 * frames))


def node_weights(positions, nodes, k):
    """Clause 13.2, exact: neighbours [N, n] and their integer weights, before division by the sum, [N, n]."""
    n = min(k, len(nodes))
    indices = np.zeros((len(positions), n), np.int64)
    weights = np.ones((len(positions), n), np.int64)
    for i, g in enumerate(positions.astype(np.int64)):
        distances = ((nodes - g) ** 2).sum(1)
        order = np.argsort(distances, kind="stable")  # ties: the lower index first
        d = [int(distances[j]) for j in order[: k + 1]]
        D = d[k] if len(nodes) > k else 2 * d[n - 1]
        w = [((D - dj << 16) // D) ** 2 if D else 0 for dj in d[:n]]
        indices[i] = order[:n]
        weights[i] = w if any(w) else 1
    return indices, weights


def quaternion_product(a, b):
    """Hamilton product of [..., 4] wxyz."""
    w, x, y, z = np.moveaxis(a, -1, 0)
    W, X, Y, Z = np.moveaxis(b, -1, 0)
    product = (
        w * W - x * X - y * Y - z * Z,
        w * X + x * W + y * Z - z * Y,
        w * Y - x * Z + y * W + z * X,
        w * Z + x * Y - y * X + z * W,
    )
    return np.stack(product, -1)


def rotate(q, v):
    """Unit quaternions [..., 4] applied to vectors [..., 3]."""
    u = q[..., 1:]
    return v + 2 * np.cross(u, np.cross(u, v) + q[..., :1] * v)


def sh_basis(d):
    """Clause 14: Y_1 .. Y_15 of unit directions [..., 3] -> [..., 15]."""
    x, y, z = np.moveaxis(d, -1, 0)
    terms = (
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    )  # fmt: skip
    return np.stack(terms, -1)


def turned_harmonics(shN, q):
    """Clause 13.4: spherical harmonics [N, K, 3] rotated by unit quaternions [N, 4]: coefficients fitted to the values
    of the rotated functions in 100 directions."""
    directions = np.random.default_rng(0).standard_normal((100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    count = shN.shape[1]
    back = rotate((q * [1, -1, -1, -1])[:, None], directions)
    values = np.einsum("nmk,nkc->nmc", sh_basis(back)[..., :count], shN)
    return np.einsum("km,nmc->nkc", np.linalg.pinv(sh_basis(directions)[:, :count]), values)


def rotation(r):
    """Rotation vectors [..., 3] -> wxyz [..., 4]."""
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    axis = np.divide(r, angle, out=np.zeros_like(r), where=angle > 0)
    return np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], -1)


def average(q, weights, first):
    """Clause 13.3: quaternions [N, n, 4] blended by weights [N, n]; each takes the sign that is nearer to q[first]."""
    before = np.take_along_axis(q, first[:, None, None], 1)
    sign = np.where((q * before).sum(-1) < 0, -1, 1)
    total = ((weights * sign)[..., None] * q).sum(1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length < 1e-12, before[:, 0], total / np.maximum(length, 1e-12))


def joint_motions(places, parents, poses):
    """Clause 13.3: G_j of poses [J, 6] as (quaternion, shift) of x -> R x + shift, for each joint."""
    motions = []
    for j, (g, parent, pose) in enumerate(zip(places, parents, poses, strict=True)):
        q = rotation(pose[:3])
        shift = g + pose[3:] - rotate(q, g)
        if parent < j:
            Q, S = motions[parent]
            q, shift = quaternion_product(Q, q), rotate(Q, shift) + S
        motions.append((q, shift))
    return motions


def predict_nodes(group, n, t):
    """Clause 13.3: node positions n [M, 3] -> positions y [M, 3] and rotations p [M, 4] predicted by the joints."""
    h, rig = group.header, group.rig
    steps = np.repeat([h.joint_rotation_step, h.joint_translation_step], 3)
    places = np.array(h.origin) + h.grid_step * rig.joints
    poses = steps * np.einsum("kcj,k->jc", rig.poses.astype(float), basis(h.frames, h.frames, t))
    now = joint_motions(places, rig.parents, poses)
    before = joint_motions(places, rig.parents, steps * rig.bind)
    y, turned = [], []  # predicted by each joint alone
    for (q, s), (q0, s0) in zip(now, before, strict=True):
        back = q0 * [1, -1, -1, -1]
        turned.append(quaternion_product(q, back))
        y.append(rotate(q, rotate(back, n - s0)) + s)
    y, turned = np.stack(y, 1), np.tile(np.array(turned), (len(n), 1, 1))
    moved = rig.weights.any(1)
    w = rig.weights / np.maximum(rig.weights.sum(1, keepdims=True), 1)
    p = average(turned, w, rig.weights.argmax(1))
    still = np.array([1.0, 0, 0, 0])
    return np.where(moved[:, None], (w[..., None] * y).sum(1), n), np.where(moved[:, None], p, still)


def blend_nodes(group, x0, t):
    """Clause 13.3: [N, 3] -> x_blend [N, 3], q_blend [N, 4]."""
    h = group.header
    b = basis(h.node_coefficients, h.frames, t)
    motion = np.einsum("kcm,k->mc", group.node_trajectories.astype(float), b)  # [M, 6]
    r, translation = h.rotation_step * motion[:, :3], h.translation_step * motion[:, 3:]
    q = rotation(r)  # [M, 4]
    n = np.array(h.origin) + h.grid_step * group.node_positions
    if group.rig is not None:
        y, p = predict_nodes(group, n, t)
        q, translation = quaternion_product(p, q), y - n + rotate(p, translation)
    j, w = node_weights(group.positions, group.node_positions.astype(np.int64), h.neighbors)
    weight = w / w.sum(1, keepdims=True)  # [N, n]
    x = (weight[..., None] * (rotate(q[j], x0[:, None] - n[j]) + n[j] + translation[j])).sum(1)
    return x, average(q[j], weight, np.zeros(len(j), int))


def expand(v, low, width, slopes):
    """Clause 13.1: [N] coded values of a companded channel -> values."""
    rise = 2.0 ** (np.array(slopes) / 16)
    before = np.concatenate([[0], rise.cumsum()])
    j = np.clip(np.floor((v - low) / width), 0, 7).astype(int)
    return low + width * before[j] + rise[j] * (v - low - j * width)


def canonical(header, attribute, integers):
    """Clause 13.1: integers [C, N] -> a0 [N, C], without the correction."""
    steps, offsets = header.channels[attribute]
    values = np.array(offsets) + np.array(steps) * integers.T
    if attribute in header.companding:
        values = np.stack(
            [expand(v, *table) for v, table in zip(values.T, header.companding[attribute], strict=True)], 1
        )
    return values


def rotations(header, channels, near):
    """Clause 13.1: quats0 [N, 4] of the births of a tile; `near`: the neighbours of each Gaussian."""
    steps, offsets = (np.array(v) for v in header.channels[QUATS])
    octaves = -canonical(header, LOG_SCALES, channels[LOG_SCALES]) @ np.array(header.scale_exponents).T
    own_steps = np.minimum(1, steps * 2.0 ** np.clip(octaves, -64, 64))
    v = np.clip(offsets + own_steps * channels[QUATS].T, -1, 1)
    residuals = None
    for c in (2, 1, 0):
        one = np.zeros((len(v), 4))
        one[:, 0], one[:, 1 + c] = np.sqrt(1 - v[:, c] ** 2), v[:, c]
        residuals = one if residuals is None else quaternion_product(residuals, one)
    quats0 = np.zeros((len(v), 4))
    for i in range(len(v)):
        known = near[i] and near[i][0] >= 512 * (i // 512)
        before = quats0[near[i][0]] if known else np.array([1.0, 0, 0, 0])
        quats0[i] = quaternion_product(before, residuals[i])
    return quats0


def unit(v):
    """Clause 13.4: [N, 3] -> wxyz [N, 4]."""
    return np.concatenate([np.sqrt(np.maximum(0, 1 - (v * v).sum(-1, keepdims=True))), v], -1)


def rgb(v):
    """Clause 13.5: [..., 3] Y, Co, Cg -> R, G, B."""
    Y, Co, Cg = np.moveaxis(v, -1, 0)
    return np.stack([Y + Co - Cg, Y + Cg, Y - Co - Cg], -1)


def evaluate(group, t):
    """Clause 13: frame t in float64: all Gaussians, and a mask of those that are shown.

    means [N, 3], quats [N, 4] wxyz, log_scales [N, 3], logit_opacities [N], sh0 [N, 3] and shN [N, K, 3] RGB,
    shown [N] bool.
    """
    h = group.header
    count = len(group.positions)
    x0 = np.array(h.origin) + h.grid_step * group.positions

    def rest(a):  # [N, C]
        return canonical(h, a, group.channels[a]) + group.correction.get(a, 0.0)

    def delta(a):  # [N, C]
        if a not in h.trajectories:
            return np.zeros((count, channel_count(a, h.sh_degree)))
        K, step = h.trajectories[a]
        return step * np.einsum("kcn,k->nc", group.trajectories[a].astype(float), basis(K, h.frames, t))

    x, q = blend_nodes(group, x0, t) if h.node_count else (x0, np.tile([1.0, 0, 0, 0], (count, 1)))
    quats = quaternion_product(quaternion_product(unit(delta(QUATS)), q), group.quats0)
    frame = {
        "means": x + delta(MEANS),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "log_scales": rest(LOG_SCALES) + delta(LOG_SCALES),
        "logit_opacities": (rest(LOGIT_OPACITIES) + delta(LOGIT_OPACITIES))[:, 0],
        "sh0": rgb(rest(SH0) + delta(SH0)),
        "shN": np.zeros((count, 0, 3)),
        "shown": np.ones(count, bool),
    }
    if h.sh_degree:
        frame["shN"] = rgb((rest(SHN) + delta(SHN)).reshape(count, -1, 3))
        if h.turned_harmonics:
            frame["shN"] = turned_harmonics(frame["shN"], q)
    if group.lifetimes is not None:
        frame["shown"] = (group.lifetimes[:, 0] <= t) & (t < group.lifetimes[:, 1])
    return frame

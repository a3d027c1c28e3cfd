"""The data model: the attribute table against the native one, ParametricGroup against a plain evaluation, rotations."""

from __future__ import annotations

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from synthetic import blob

from gscodec import _native
from gscodec.model import rotations
from gscodec.model.attributes import ATTRIBUTES, COMPANDED
from gscodec.model.gaussians import Gaussians
from gscodec.model.parametric_group import NodeMotion, ParametricGroup
from gscodec.render.reference import sh_basis

# ---- Attributes -----------------------------------------------------------------------------------------------------


def test_the_attribute_table_is_the_native_one():
    own = [{n: getattr(a, n) for n in ("name", "number", "channels", "companded")} for a in ATTRIBUTES]
    assert own == _native.attributes()
    assert COMPANDED == tuple(a["name"] for a in _native.attributes() if a["companded"])
    assert [a.name for a in ATTRIBUTES] == [f.name for f in sorted_fields(Gaussians)]


def sorted_fields(cls):
    """Fields of a Gaussian in the order of their numbers in the stream."""
    number = {a.name: a.number for a in ATTRIBUTES}
    return sorted(fields(cls), key=lambda f: number[f.name])


# ---- Evaluation of groups -------------------------------------------------------------------------------------------


def unit(q):
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def hamilton(a, b):
    """Product of quaternions [..., 4] by the multiplication table of i, j, k."""
    table = [[(0, 1), (1, 1), (2, 1), (3, 1)], [(1, 1), (0, -1), (3, 1), (2, -1)]]
    table += [[(2, 1), (3, -1), (0, -1), (1, 1)], [(3, 1), (2, 1), (1, -1), (0, -1)]]
    out = np.zeros(np.broadcast_shapes(a.shape, b.shape))
    for i, row in enumerate(table):
        for j, (k, sign) in enumerate(row):
            out[..., k] += sign * a[..., i] * b[..., j]
    return out


def rodrigues(v):
    """Rotation vectors [..., 3] -> matrices [..., 3, 3] and quaternions [..., 4]."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(v / angle[..., 0], -1, 0)
    o = np.zeros_like(x)
    K = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)
    half = angle[..., 0] / 2
    q = np.concatenate([np.cos(half), np.sin(half) * np.stack([x, y, z], -1)], -1)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K), q


def expected_carry(group):
    """Means [T, N, 3] and rotations [T, N, 4]: sum over j of w_j (R_j (x - n_j) + n_j + t_j), quaternions likewise."""
    nodes, x = group.nodes, group.canonical.means.astype(float)
    R, q = rodrigues(nodes.rotations)  # [T, M, 3, 3], [T, M, 4]
    j, w = nodes.neighbors, nodes.weights[..., None]
    at = nodes.positions[j]  # [N, k, 3]
    moved = np.einsum("tnkab,nkb->tnka", R[:, j], x[:, None] - at) + at + nodes.translations[:, j]
    turned = q[:, j]
    turned *= np.where((turned * turned[:, :, :1]).sum(-1, keepdims=True) < 0, -1, 1)
    return (w * moved).sum(2), unit((w * turned).sum(2))


def expected_frames(group):
    """All frames of a group with nodes and a trajectory of each attribute: attribute -> [T, N, ...]."""
    frames = len(group)
    k, t = np.arange(frames)[:, None], np.arange(frames)
    basis = np.sqrt(np.where(k == 0, 1, 2) / frames) * np.cos(np.pi * (2 * t + 1) * k / (2 * frames))
    deltas = {n: np.einsum("kt,kcn->tnc", basis[: len(c)], c) for n, c in group.trajectories.items()}
    means, turns = expected_carry(group)
    xyz = deltas.pop("quats")
    own = np.concatenate([np.sqrt(1 - (xyz**2).sum(-1, keepdims=True)), xyz], -1)
    out = {"means": means + deltas.pop("means"), "quats": hamilton(own, hamilton(turns, group.canonical.quats))}
    for name, delta in deltas.items():
        rest = getattr(group.canonical, name)
        out[name] = rest + delta.reshape(frames, *rest.shape)
    return out


def random_group(n=150, frames=7, m=12, k=4, angle=2.5, seed=0):
    """A group with nodes that rotate by about `angle`, and trajectories of all attributes, half of them 0."""
    rng = np.random.default_rng(seed)
    f32 = lambda a: np.asarray(a, np.float32)  # noqa: E731
    canonical = blob(n, seed, sh_count=3)
    nodes = NodeMotion(
        positions=f32(rng.normal(size=(m, 3))),
        rotations=f32(angle / np.sqrt(3) * rng.normal(size=(frames, m, 3))),
        translations=f32(0.3 * rng.normal(size=(frames, m, 3))),
        neighbors=rng.permuted(np.tile(np.arange(m, dtype=np.int32), (n, 1)), axis=1)[:, :k],
        weights=f32(-np.sort(-rng.dirichlet(np.ones(k), n), axis=1)),
    )
    trajectories = {}
    for i, a in enumerate(ATTRIBUTES):
        c = 0.1 * rng.normal(size=(1 + i % frames, 9 if a.name == "shN" else a.channels, n))
        trajectories[a.name] = f32(c * (rng.random(n) < 0.5))
    return ParametricGroup(frames, canonical, nodes, trajectories)


GROUPS = {
    "aligned": {"angle": 0.3},
    "large rotations": {"angle": 2.5},
    "one neighbour": {"k": 1},
    "three neighbours": {"k": 3},
    "eight neighbours": {"k": 8},
    "one frame": {"frames": 1},
    "many Gaussians": {"n": 5000, "frames": 3},
}


@pytest.mark.parametrize("options", GROUPS.values(), ids=GROUPS)
def test_groups_follow_a_plain_evaluation(options):
    group = random_group(**options)
    group = replace(group, trajectories={n: c[: len(group)] for n, c in group.trajectories.items()})
    want = expected_frames(group)
    for t in range(len(group)):
        frame = group.frame(t)
        for name, values in want.items():
            np.testing.assert_allclose(getattr(frame, name), values[t], atol=1e-5, err_msg=f"{name}, frame {t}")
    for got, expected in zip(group.carried(), expected_carry(group), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-5)
    means, quats = group.moved()
    np.testing.assert_allclose(means, want["means"], atol=1e-5)
    np.testing.assert_allclose(quats, want["quats"], atol=1e-5)


def test_large_rotations_need_signs():
    """Without opposite signs the case above would not test the alignment of quaternions before blending."""
    group = random_group(**GROUPS["large rotations"])
    _, q = rodrigues(group.nodes.rotations)
    near = q[:, group.nodes.neighbors]
    assert 0.2 < ((near * near[:, :, :1]).sum(-1) < 0).mean() < 0.8


def test_groups_without_nodes_rest():
    group = ParametricGroup(3, blob(20))
    means, turns = group.carried()
    np.testing.assert_array_equal(means, np.broadcast_to(group.canonical.means, (3, 20, 3)))
    np.testing.assert_array_equal(turns, np.broadcast_to([1.0, 0, 0, 0], (3, 20, 4)))
    for f in fields(Gaussians):
        np.testing.assert_allclose(getattr(group.frame(2), f.name), getattr(group.canonical, f.name), atol=1e-7)
    with pytest.raises(IndexError, match="frame 3 of a group of 3"):
        group.frame(3)


def test_lifetimes_hide_gaussians():
    lifetimes = np.array([[0, 2], [1, 3], [2, 3]], np.int32)
    group = ParametricGroup(3, blob(3), lifetimes=lifetimes)
    for t, shown in enumerate(([0], [0, 1], [1, 2])):
        np.testing.assert_array_equal(group.visible(t).means, group.canonical.means[shown])
        assert len(group.frame(t)) == 3


def test_a_part_of_a_group_is_evaluated_like_the_whole():
    group, index = random_group(), np.array([5, 3, 140, 77])
    part, whole = group.take(index).frame(4), group.frame(4).take(index)
    for f in fields(Gaussians):
        np.testing.assert_array_equal(getattr(part, f.name), getattr(whole, f.name))


def test_groups_pickle_without_their_evaluator():
    group = random_group()
    want = group.frame(3)
    again = pickle.loads(pickle.dumps(group)).frame(3)
    for f in fields(Gaussians):
        np.testing.assert_array_equal(getattr(again, f.name), getattr(want, f.name))


def with_nodes(group, **change):
    return replace(group, nodes=replace(group.nodes, **change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: with_nodes(g, weights=g.nodes.weights[:, :2]), "neighbors and weights: expected shape"),
        (lambda g: with_nodes(g, neighbors=g.nodes.neighbors[:9], weights=g.nodes.weights[:9]), r"shape \[150, k\]"),
        (lambda g: with_nodes(g, positions=g.nodes.positions[:9]), r"of nodes: expected shape \[K, 6, 9\]"),
        (lambda g: replace(g, trajectories={"colour": np.zeros((1, 3, 150))}), "unknown attribute 'colour'"),
        (lambda g: replace(g, trajectories={"sh0": np.zeros((1, 3, 9))}), r"sh0: expected shape \[K, 3, 150\]"),
        (lambda g: replace(g, trajectories={"shN": np.zeros((1, 3, 150))}), r"shN: expected shape \[K, 9, 150\]"),
    ],
)
def test_shapes_that_do_not_match_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        change(random_group()).frame(0)


# ---- Rigid motions of nodes -----------------------------------------------------------------------------------------


def f32(*arrays):
    return tuple(np.ascontiguousarray(a, np.float32) for a in arrays)


def random_nodes(n, m, k, flipped, seed=0):
    """Nodes: rest positions [M, 3], rotations [M, 4] near each other up to signs, positions [M, 3]. Gaussians: rest
    positions [N, 3], neighbors [N, k], weights [N, k]."""
    rng = np.random.default_rng(seed)
    q = unit([1, 0, 0, 0] + 0.2 * rng.normal(size=(m, 4)))
    if flipped:
        q *= np.where(np.arange(m) % 2, -1, 1)[:, None]
    nodes = f32(rng.normal(size=(m, 3)), q, rng.normal(size=(m, 3)))
    neighbors = rng.permuted(np.tile(np.arange(m, dtype=np.uint32), (n, 1)), axis=1)[:, :k]
    x, weights = f32(rng.normal(size=(n, 3)), rng.dirichlet(np.ones(k), n))
    return nodes, (x, np.ascontiguousarray(neighbors), weights)


@pytest.mark.parametrize("angle", [0, 1e-3, 0.3, 2.0])
@pytest.mark.parametrize("flipped", [False, True], ids=["aligned", "flipped"])
@pytest.mark.parametrize(("n", "k"), [(60, 3), (3000, 4)])
def test_gradients_of_the_nodes_are_those_of_the_formulas(n, k, flipped, angle):
    """Spec 13.3, and the as-rigid-as-possible term (Sorkine and Alexa 2007), differentiated by torch in f64."""
    torch = pytest.importorskip("torch")
    (rest, base, positions), (x, neighbors, weights) = random_nodes(n, 5, k, flipped)
    rng = np.random.default_rng(1)
    by_means, by_rotations, turns = f32(*(rng.normal(size=s) for s in ((n, 3), (n, 4), (5, 3))))
    edges, lengths = rng.permuted(np.tile(np.arange(5, dtype=np.uint32), (5, 1)), axis=1)[:, :3].copy(), rng.random(15)
    lengths, strength, turns = *f32(lengths.reshape(5, 3)), 5.0, turns * np.float32(angle)

    t = lambda a: torch.from_numpy(a.astype(np.float64))  # noqa: E731
    turn, shift = t(turns).requires_grad_(), torch.zeros(5, 3, dtype=torch.float64, requires_grad=True)
    q = rotations.quat_normalize(rotations.quat_multiply(rotations.rotvec_to_quat(turn), t(base)))
    R, p, near, w = rotations.quat_to_matrix(q), t(positions) + shift, neighbors.astype(int), t(weights)[..., None]
    moved = (R[near] @ (t(x)[:, None] - t(rest)[near])[..., None])[..., 0] + p[near]
    signs = torch.where((q[near] * q[near[:, :1]]).sum(2, keepdim=True) < 0, -1.0, 1.0)
    means, turned = (w * moved).sum(1), rotations.quat_normalize((w * signs * q[near]).sum(1))
    ends = edges.astype(int)
    missed = (R[:, None] @ (t(rest)[ends] - t(rest)[:, None])[..., None])[..., 0] - (p[ends] - p[:, None])
    rigidity = ((t(lengths)[..., None] * missed).square().sum(2) + 1e-12).sqrt().mean()
    ((means * t(by_means)).sum() + (turned * t(by_rotations)).sum() + strength * rigidity).backward()

    nodes = f32(rest, q.detach().numpy(), positions)
    for got, want in zip(_native.blend_rigid(nodes, x, neighbors, weights), (means, turned), strict=True):
        np.testing.assert_allclose(got, want.detach().numpy(), atol=1e-5)
    blend = (x, neighbors, weights)
    got = _native.node_gradients(nodes, (turns, base), blend, (by_means, by_rotations), (edges, lengths, strength))
    for g, want in zip(got, (turn.grad, shift.grad), strict=True):
        np.testing.assert_allclose(g, want.numpy(), atol=1e-5 * want.abs().max().item())


def test_nodes_of_other_shapes_are_refused():
    nodes, blend = random_nodes(10, 5, 3, False)
    with pytest.raises(ValueError, match=r"rotations of nodes: expected shape \[5, 4\], got \[5, 3\]"):
        _native.blend_rigid((nodes[0], nodes[0], nodes[2]), *blend)
    with pytest.raises(ValueError, match=r"neighbors and weights: expected shape \[10, k\]"):
        _native.blend_rigid(nodes, blend[0], blend[1], blend[2][:, :2].copy())
    turned, edges = (nodes[2], nodes[1]), (np.zeros((5, 1), np.uint32), np.zeros((5, 1), "f4"), 1.0)
    by_means, by_rotations = np.zeros((10, 3), "f4"), np.zeros((10, 4), "f4")
    with pytest.raises(ValueError, match=r"by_means: expected shape \[10, 3\], got \[9, 3\]"):
        _native.node_gradients(nodes, turned, blend, (by_means[1:], by_rotations), edges)
    with pytest.raises(ValueError, match=r"by_rotations: expected shape \[10, 4\], got \[10, 3\]"):
        _native.node_gradients(nodes, turned, blend, (by_means, by_means), edges)
    with pytest.raises(ValueError, match="neighbors: expected indices of 5 nodes"):
        _native.node_gradients(nodes, turned, blend, (by_means, by_rotations), (edges[0] + 5, *edges[1:]))


def test_neighbours_of_a_context_are_the_nearest_before():
    """Spec 7.3."""
    p = np.random.default_rng(0).integers(0, 16, (200, 3)).astype(np.uint32)
    p = p[_native.morton_order(p)]
    got = _native.context_neighbors(p)
    assert got.shape == (200, 4)
    for i in range(200):
        distance = lambda j: (((p[i].astype(int) - p[j].astype(int)) ** 2).sum(), i - j)  # noqa: B023, E731
        near = sorted(range(max(0, i - 32), i), key=distance)[:4]
        assert got[i].tolist() == near + [i] * (4 - len(near))


# ---- Rotations ------------------------------------------------------------------------------------------------------


def random_quats(n, seed=0):
    return unit(np.random.default_rng(seed).normal(size=(n, 4)))


def test_products_compose():
    a, b, v = random_quats(50), random_quats(50, 1), np.random.default_rng(2).normal(size=(50, 3))
    ab = rotations.quat_multiply(a, b)
    np.testing.assert_allclose(ab, hamilton(a, b), atol=1e-12)
    np.testing.assert_allclose(rotations.rotate(ab, v), rotations.rotate(a, rotations.rotate(b, v)), atol=1e-12)
    matrix = rotations.quat_to_matrix
    np.testing.assert_allclose(matrix(ab), matrix(a) @ matrix(b), atol=1e-12)
    identity = np.broadcast_to([1.0, 0, 0, 0], a.shape)
    np.testing.assert_allclose(rotations.quat_multiply(a, rotations.quat_conjugate(a)), identity, atol=1e-12)


def test_rotate_is_the_matrix():
    q, v = random_quats(50), np.random.default_rng(1).normal(size=(50, 3))
    R = rotations.quat_to_matrix(q)
    np.testing.assert_allclose(rotations.rotate(q, v), np.einsum("nab,nb->na", R, v), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    back = rotations.matrix_to_quat(R)
    np.testing.assert_allclose(back * np.sign((back * q).sum(1, keepdims=True)), q, atol=1e-12)


def test_rotation_vectors_are_quaternions():
    v = np.random.default_rng(0).normal(size=(50, 3))
    R, q = rodrigues(v)
    np.testing.assert_allclose(rotations.rotvec_to_quat(v), q, atol=1e-12)
    np.testing.assert_allclose(rotations.quat_to_matrix(q), R, atol=1e-12)
    v *= (3 / np.linalg.norm(v, axis=1, keepdims=True)).clip(None, 1)  # less than half a turn
    np.testing.assert_allclose(rotations.quat_to_rotvec(rotations.rotvec_to_quat(v)), v, atol=1e-6)
    np.testing.assert_allclose(rotations.rotvec_to_quat(np.zeros(3)), [1, 0, 0, 0], atol=1e-8)


def test_rotation_vectors_near_the_one_before_have_no_jumps():
    """Five turns and back about a moving axis, from the quaternion or its negative."""
    t = np.linspace(0, 1, 400)[:, None]
    axis = unit(np.concatenate([np.cos(t), np.sin(t), t], 1))
    want = axis * (0.1 + 10 * np.pi * np.sin(np.pi * t))
    quats = rotations.rotvec_to_quat(want) * np.where(np.arange(400) % 3, 1, -1)[:, None]
    near, got = want[0], []
    for q in quats:
        near = rotations.quat_to_rotvec(q, near)
        got.append(near)
    np.testing.assert_allclose(got, want, atol=1e-6)
    alone = rotations.quat_to_rotvec(quats)
    assert np.linalg.norm(np.diff(alone, axis=0), axis=1).max() > 5  # jumps without `near`


def test_normalized_quaternions_have_unit_length():
    q = np.random.default_rng(0).normal(size=(20, 4))
    q[3] = 0
    length = np.linalg.norm(rotations.quat_normalize(q), axis=1)
    np.testing.assert_allclose(length, np.arange(20) != 3, atol=1e-12)


TWICE = {
    "quat_multiply": ((30, 4), (30, 4)),
    "quat_conjugate": ((30, 4),),
    "quat_normalize": ((30, 4),),
    "rotate": ((30, 4), (30, 3)),
    "rotvec_to_quat": ((30, 3),),
    "quat_to_rotvec": ((30, 4),),
    "quat_to_rotvec near": ((30, 4), (30, 3)),
    "quat_to_matrix": ((30, 4),),
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(("name", "shapes"), TWICE.items(), ids=TWICE)
def test_tensors_rotate_like_arrays(name, shapes, dtype):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=s) for s in shapes]
    arrays = [(unit(a) if a.shape[-1] == 4 else 5 * a).astype(dtype) for a in arrays]
    function = getattr(rotations, name.split()[0])
    want, got = function(*arrays), function(*(torch.tensor(a) for a in arrays))
    assert isinstance(got, torch.Tensor)
    assert got.numpy().dtype == want.dtype == np.dtype(dtype)
    np.testing.assert_allclose(got.numpy(), want, atol=1e-5 if dtype == "float32" else 1e-12)


def test_rotation_vectors_have_a_gradient_at_zero():
    torch = pytest.importorskip("torch")
    v = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    rotations.rotvec_to_quat(v)[1:].sum().backward()
    np.testing.assert_allclose(v.grad.numpy(), 0.5, atol=1e-6)


def test_harmonics_turn_with_the_nodes():
    """The colour in a direction is the colour at rest in the direction rotated back; spec 13.4."""
    group = random_group()
    turned, directions = replace(group, turned_harmonics=True), unit(np.random.default_rng(1).normal(size=(20, 3)))
    basis = lambda d: sh_basis(torch.from_numpy(d.reshape(-1, 3)), 3).numpy().reshape(*d.shape[:-1], 3)  # noqa: E731
    for t in (0, 4):
        back = expected_carry(group)[1][t] * [1, -1, -1, -1]
        seen = np.stack([rotations.rotate(np.broadcast_to(q, (20, 4)), directions) for q in back])  # [N, 20, 3]
        expected = np.einsum("ndk,nkc->ndc", basis(seen), group.frame(t).shN)
        found = np.einsum("dk,nkc->ndc", basis(directions), turned.frame(t).shN)
        np.testing.assert_allclose(found, expected, atol=1e-4)
        assert np.abs(turned.frame(t).shN - group.frame(t).shN).max() > 0.1
        np.testing.assert_array_equal(turned.frame(t).sh0, group.frame(t).sh0)
    still = replace(turned, nodes=None)
    np.testing.assert_array_equal(still.frame(4).shN, group.frame(4).shN)
    assert turned.harmonics_turns().shape == (7, 150, 4)
    assert still.harmonics_turns() is None

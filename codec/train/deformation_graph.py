"""Deformation graph: a few hundred nodes whose rigid motions carry all Gaussians (HiFi4G's coarse graph).

The stream holds the same nodes (spec 13.2 and 13.3: same neighbours, same weights). Tracking optimises them, so that a
smooth motion is smooth by construction and cheap to code.

Gaussians added later have nodes of their own. The decoder blends the nearest nodes, whichever Gaussians they were added
for. So new Gaussians and their nodes rest at a free place beside all others, and the translations of the nodes move
them into the scene.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from .. import _native
from ..farthest_point_sampling import farthest_points
from ..model.rotations import quat_multiply, quat_normalize, rotvec_to_quat
from .settings import DeformationGraphSettings


@dataclass
class Pose:
    """Motion of the nodes since the keyframe, and their velocity.

    Attributes:
        nodes: [M, 3] positions, world units.
        rotations: [M, 4] unit wxyz.
        angular_velocity: [M, 3] rotation vectors, radians a frame.
        velocity: [M, 3] world units a frame.
    """

    nodes: torch.Tensor
    rotations: torch.Tensor
    angular_velocity: torch.Tensor
    velocity: torch.Tensor

    @staticmethod
    def rest(graph: NodeGraph) -> Pose:
        """The pose of the keyframe."""
        zero = torch.zeros_like(graph.nodes)
        return Pose(graph.nodes, rotvec_to_quat(zero), zero, zero)

    def next(self) -> Pose:
        """The pose a frame later, at constant velocity."""
        return self.moved(self.angular_velocity, self.velocity)

    def moved(self, turn: torch.Tensor, shift: torch.Tensor) -> Pose:
        """The nodes turned by `turn` ([M, 3] rotation vectors) and shifted by `shift` ([M, 3] world units); their
        velocity stays the same."""
        rotations = quat_normalize(quat_multiply(rotvec_to_quat(turn), self.rotations))
        return replace(self, nodes=self.nodes + shift, rotations=rotations)

    def extended(self, nodes: torch.Tensor) -> Pose:
        """The pose with K more nodes at `nodes` [K, 3], which have not moved yet."""
        zero = torch.zeros_like(nodes)
        more = Pose(nodes, rotvec_to_quat(zero), zero, zero)
        return Pose(*(torch.cat([getattr(self, f.name), getattr(more, f.name)]) for f in fields(Pose)))


class NodeGraph:
    """Nodes of a keyframe and of Gaussians added since, and the weights by which they carry Gaussians.

    Args:
        means: [N, 3] positions at rest, for Gaussians of the keyframe their positions there.
        low: [3], origin of the lattice, world units.
        step: spacing of the lattice, world units.
        chosen: [M, 3] u32, lattice coordinates of the nodes.
        batch: [M] int; 0 for nodes of the keyframe, else the number of the batch of Gaussians added with the node.
        extent: [3], size of the keyframe, world units.
        held: [M] bool, nodes that do not move.

    Attributes:
        nodes: [M, 3] positions of the nodes at rest.
        neighbors: [N, k] u32, nodes that carry each Gaussian, the nearest first.
        weights: [N, k] f32, blending weights of these nodes.
    """

    def __init__(
        self,
        means: torch.Tensor,
        low: torch.Tensor,
        step: float,
        chosen: np.ndarray,
        batch: np.ndarray,
        extent: torch.Tensor,
        held: np.ndarray,
        settings: DeformationGraphSettings,
    ):
        self.settings, self.held = settings, held
        self.low, self.step, self.extent = low, step, extent
        self.chosen, self.batch = chosen, batch
        self._connect()
        self.means = means[:0]
        self.extend(means)

    def _connect(self) -> None:
        """Sets positions of the nodes and the edges between them."""
        from scipy.spatial import cKDTree

        self.nodes = self.low + self.step * torch.from_numpy(self.chosen.astype(np.float32))
        m, k = len(self.chosen), min(self.settings.edges, len(self.chosen) - 1)
        near = cKDTree(self.nodes.numpy()).query(self.nodes.numpy(), k + 1)[1].reshape(m, -1)[:, 1:]
        length = (self.nodes[near.astype(np.int64)] - self.nodes[:, None]).norm(dim=2)
        median = length.median() if k else torch.ones(())
        falloff = self.settings.edge_falloff * median
        weight = torch.exp2(-((length / falloff) ** 2))  # long edges bridge gaps: less weight
        self._edges = np.ascontiguousarray(near, np.uint32), (weight * self.settings.lattice / self.step).numpy()

    @staticmethod
    def of(
        means: torch.Tensor,
        sizes: torch.Tensor,
        radius: float,
        moving: torch.Tensor,
        settings: DeformationGraphSettings,
        far: torch.Tensor | None = None,
    ) -> NodeGraph:
        """Nodes for the Gaussians of a keyframe, dense where these move and where they are small.

        Args:
            means: [N, 3] world units.
            sizes: [N], spacing of the nodes near each Gaussian, in any unit.
            radius: of the moving Gaussians, world units.
            moving: [N] bool.
            far: [N] bool, Gaussians that never move: nodes that carry some of them are held. None: no Gaussians.
        """
        low, step, nodes = means.min(0).values, settings.lattice * radius, settings.nodes
        grid = torch.round((means - low) / step).numpy().astype(np.uint32)
        if (~moving).float().mean() < settings.still_share:  # nodes at rest among moving ones would hold these back
            moving = torch.ones_like(moving)
        still = int(settings.still_share * nodes) if (~moving).any() else 0
        some = [np.zeros((0, 3), np.uint32)]
        for mask, most in ((moving, nodes - still), (~moving, still)):
            if mask.any() and most:
                some.append(grid[mask.numpy()][farthest_points(means[mask].numpy(), most, sizes[mask].numpy())])
        chosen = np.unique(np.concatenate(some), axis=0)
        chosen = chosen[_native.morton_order(chosen)]
        batch, held, extent = np.zeros(len(chosen), int), np.zeros(len(chosen), bool), means.max(0).values - low
        graph = NodeGraph(means, low, step, chosen, batch, extent, held, settings)
        if far is not None:
            graph.held = graph.carriers(far).numpy()
        return graph

    def extend(self, means: torch.Tensor) -> None:
        """Adds Gaussians to carry, which rest at `means` [K, 3]."""
        index, weight = (_padded(a, self.settings.blended) for a in self._weights(means, self.chosen))
        if len(self.means):
            index, weight = np.concatenate([self.neighbors, index]), np.concatenate([self.weights, weight])
        self.neighbors, self.weights = index, weight
        self.means = torch.cat([self.means, means])

    def _weights(self, means: torch.Tensor, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes of `chosen` that carry Gaussians at `means` [N, 3] (indices [N, k]), and their weights [N, k]."""
        return _native.node_weights(self._on_lattice(means), chosen, self.settings.blended)

    def _on_lattice(self, means: torch.Tensor) -> np.ndarray:
        return torch.round((means - self.low) / self.step).clamp(min=0).numpy().astype(np.uint32)

    def add_nodes(self, means: torch.Tensor) -> torch.Tensor | None:
        """Adds nodes for new Gaussians at `means` [K, 3], and finds a place where both rest.

        Returns:
            Shift [3] from `means` to that place, where they change no other Gaussian's nodes or weights. None: no room.
        """
        own = means[torch.from_numpy(farthest_points(means.numpy(), self.settings.added_nodes))]
        before = self._weights(self.means, self.chosen)
        for shift in self._places(means):
            more = np.unique(self._on_lattice(own + shift), axis=0)
            chosen = np.concatenate([self.chosen, more[_native.morton_order(more)]])
            after = self._weights(self.means, chosen)
            alone = (self._weights(means + shift, chosen)[0] >= len(self.chosen)).all()
            if alone and all(np.array_equal(a, b) for a, b in zip(before, after, strict=True)):
                self.batch = np.concatenate([self.batch, np.full(len(more), self.batch.max() + 1)])
                self.held = np.concatenate([self.held, np.zeros(len(more), bool)])
                self.chosen = chosen
                self._connect()
                return shift
        return None

    def _places(self, means: torch.Tensor):
        """Shifts [3] of `means` to places beside all Gaussians at rest, along the lattice axis with most room."""
        low, high = means.min(0).values, means.max(0).values
        start, size = self.means.max(0).values, high - low
        room = self.low + self.settings.extent_max * self.extent.max() - size - start
        axis = int(room.argmax())
        for k in range(self.settings.places_max):
            away = (0.5 + 0.5 * k) * size.max()
            if away > room[axis]:
                return
            shift = self.low + self.extent / 2 - (low + high) / 2
            shift[axis] = start[axis] + away - low[axis]
            yield shift

    def batch_of(self) -> np.ndarray:
        """Batch of the nodes that carry each Gaussian, [N] int."""
        return self.batch[self.neighbors[:, 0]]

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays."""
        return {n: np.asarray(getattr(self, n)) for n in ("means", "low", "step", "chosen", "batch", "extent", "held")}

    @staticmethod
    def restored(state: dict[str, np.ndarray], settings: DeformationGraphSettings) -> NodeGraph:
        """Inverse of `state`."""
        means, low, extent = (torch.from_numpy(state[n]) for n in ("means", "low", "extent"))
        chosen, batch, held = state["chosen"], state["batch"], state["held"]
        return NodeGraph(means, low, float(state["step"]), chosen, batch, extent, held, settings)

    def copy(self) -> NodeGraph:
        """The same nodes; Gaussians added to the copy are not added here."""
        return NodeGraph.restored(self.state(), self.settings)

    def resting_at(self, means: torch.Tensor) -> NodeGraph:
        """The same nodes for Gaussians that rest at `means` [N, 3]."""
        return NodeGraph.restored({**self.state(), "means": means.numpy()}, self.settings)

    def select(self, chosen: torch.Tensor) -> None:
        """Keeps the Gaussians of `chosen` ([N] bool)."""
        self.means = self.means[chosen]
        self.neighbors, self.weights = (np.ascontiguousarray(a[chosen.numpy()]) for a in (self.neighbors, self.weights))

    def __len__(self) -> int:
        return len(self.nodes)

    def carry(self, x: torch.Tensor, pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
        """Points at rest moved by the blended rigid motions of the nodes (spec 13.3).

        Args:
            x: [N, 3], at rest.

        Returns:
            means [N, 3] and the blended rotation [N, 4] unit wxyz.
        """
        carried = _native.blend_rigid(self._at(pose), x.numpy(), self.neighbors, self.weights)
        return tuple(torch.from_numpy(a) for a in carried)

    def gradients(
        self,
        x: torch.Tensor,
        base: tuple[torch.Tensor, torch.Tensor],
        pose: Pose,
        by_carried: tuple[torch.Tensor, torch.Tensor],
        rigidity: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradients [M, 3] and [M, 3] by the turn and the shift of the nodes (`Pose.moved`), of a loss and of the
        as-rigid-as-possible term (Sorkine and Alexa 2007): the mean weighted distance between each edge as it is and as
        its node rotates it, in lattice spacings times `lattice`.

        Args:
            x: [N, 3], at rest.
            base: rotations [M, 4] before the turn, and the turn [M, 3].
            pose: of the nodes after the turn.
            by_carried: gradients of the loss by the results of `carry`, [N, 3] and [N, 4].
            rigidity: weight of the as-rigid-as-possible term.
        """
        rotations, turn = (a.contiguous().numpy() for a in base)
        blend = x.numpy(), self.neighbors, self.weights
        by = tuple(g.contiguous().numpy() for g in by_carried)
        grads = _native.node_gradients(self._at(pose), (turn, rotations), blend, by, (*self._edges, rigidity))
        return tuple(torch.from_numpy(g) for g in grads)

    def _at(self, pose: Pose) -> tuple[np.ndarray, ...]:
        return self.nodes.numpy(), pose.rotations.numpy(), pose.nodes.numpy()

    def carriers(self, chosen: torch.Tensor) -> torch.Tensor:
        """Nodes that carry a Gaussian of `chosen` ([N] bool) with a weight of more than `carrier_weight_min`, without
        held nodes, [M] bool."""
        some = chosen.numpy()
        carried = self.neighbors[some][self.weights[some] > self.settings.carrier_weight_min]
        return torch.from_numpy(np.isin(np.arange(len(self)), carried) & ~self.held)

    def among(self, nodes: torch.Tensor) -> torch.Tensor:
        """[M] bool: those of `nodes` ([M] bool) all of whose neighbours are of `nodes`, too."""
        return nodes & torch.from_numpy(nodes.numpy()[self._edges[0]].all(1))

    def mean_of_carried(self, x: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
        """[M], mean of `x` [N] over the Gaussians of `chosen` ([N] bool) that each node and its neighbours carry, by
        blending weight; infinity if they carry none."""
        weights = self.weights * chosen.numpy()[:, None]
        of_node = (weights, weights * x.numpy()[:, None])
        sums = np.array([np.bincount(self.neighbors.ravel(), w.ravel(), len(self)) for w in of_node])
        count, total = sums + sums[:, self._edges[0]].sum(2)
        return torch.from_numpy(np.divide(total, count, out=np.full(len(self), np.inf), where=count > 0)).float()


def _padded(a: np.ndarray, width: int) -> np.ndarray:
    """[N, k] -> [N, width], padded with zeros: a group with few nodes may get more."""
    return np.ascontiguousarray(np.pad(a, ((0, 0), (0, width - a.shape[1]))))

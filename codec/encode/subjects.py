"""Subjects of a coded track: the parts of its Gaussians that never touch each other.

Decoded groups -> a label for each Gaussian of each group. Two Gaussians are connected if they are neighbours and stay
near in every frame in which both exist; connected components are subjects. So two men who stand apart are two subjects,
and a ball is a subject if it leaves the hand. Groups that are predicted from each other share their Gaussians; in the
next independent group, each part takes the label of the Gaussians nearest to it; the number of subjects does not grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..bitstream.quantization import subject_radius
from ..decode.stream import Stream

NEIGHBORS = 12  # nearest Gaussians that a Gaussian may be connected to
REACH = 0.1  # of the radius of the track, largest distance of connected Gaussians (basketball: 0.04 to 0.3 work)
SPACING = 3.0  # times the median distance of the nearest Gaussian, lower bound of that distance
MOST = 8  # subjects; with more, the parts of the track are no subjects
SHARE_LEAST = 0.02  # least share of the Gaussians in a subject


@dataclass(frozen=True)
class _Group:
    """A group of a stream: its means [T, N, 3], and identities [N], shared by groups predicted from each other."""

    means: np.ndarray
    identities: np.ndarray


def find_subjects(stream: Stream) -> list[np.ndarray]:
    """Labels [N] of each group; 0 is the largest subject of the first groups. All 0 if there is one subject, or if
    there are more than `MOST`."""
    reach = None
    found: list[np.ndarray] = []
    last: tuple[np.ndarray, np.ndarray] | None = None  # means and labels in the last frame with Gaussians
    for segment in _segments(stream):
        shown = [k for k, g in enumerate(segment) if len(g.identities)]
        if not shown:
            found += [np.zeros(0, int) for _ in segment]
            continue
        reach = reach or _reach(segment[shown[0]].means[0])
        own = _components(segment, reach)
        table = _by_size(own) if last is None else _by_place(own, segment, *last)
        own = [table[labels] for labels in own]
        found += own
        last = segment[shown[-1]].means[-1], own[shown[-1]]
    count = max((int(labels.max(initial=0)) for labels in found), default=0) + 1
    return found if count <= MOST else [np.zeros_like(labels) for labels in found]


def _segments(stream: Stream):
    """Yields lists of groups: an independent group and the groups after it that are predicted from it."""
    segment: list[_Group] = []
    for i, (group, identities) in enumerate(zip(stream.sequence().groups, stream.identities(), strict=True)):
        if segment and stream.group(i).reference == 0:
            yield segment
            segment = []
        segment.append(_Group(group.moved()[0], identities))
    if segment:
        yield segment


def _reach(means: np.ndarray) -> float:
    """Largest distance of connected Gaussians, world units, from size and density of a track; `means`: [N, 3]."""
    from scipy.spatial import cKDTree

    if len(means) < 2:
        return 1.0
    return max(REACH * subject_radius(means), SPACING * float(np.median(cKDTree(means).query(means, 2)[0][:, 1])))


def _components(segment: list[_Group], reach: float) -> list[np.ndarray]:
    """[N] component of each Gaussian of each group, numbers from 0 on, without components that are too small."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    names, index = np.unique(np.concatenate([g.identities for g in segment]), return_inverse=True)
    count, ids = len(names), np.split(index, np.cumsum([len(g.identities) for g in segment])[:-1])
    if not count:
        return ids
    pairs = np.unique(np.concatenate([_pairs(g, own) for g, own in zip(segment, ids, strict=True)]), axis=0)
    near = np.ones(len(pairs), bool)
    for g, own in zip(segment, ids, strict=True):
        place = np.full(count, -1)
        place[own] = np.arange(len(own))
        i, j = place[pairs].T
        there = (i >= 0) & (j >= 0)
        apart = np.linalg.norm(g.means[:, i[there]] - g.means[:, j[there]], axis=2).max(0, initial=0)
        near[there] &= apart < reach
    i, j = pairs[near].T
    labels = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (count, count)), directed=False)[1]
    labels = _without_small(labels, segment, ids)
    return [labels[own] for own in ids]


def _pairs(g: _Group, own: np.ndarray) -> np.ndarray:
    """[P, 2] identities of neighbours in the middle frame."""
    from scipy.spatial import cKDTree

    middle, k = g.means[len(g.means) // 2], min(NEIGHBORS + 1, len(own))
    if k < 2:
        return np.zeros((0, 2), np.int64)
    near = cKDTree(middle).query(middle, k)[1][:, 1:]
    return np.sort(np.column_stack([np.repeat(own, k - 1), own[near.ravel()]]), axis=1)


def _without_small(labels: np.ndarray, segment: list[_Group], ids: list[np.ndarray]) -> np.ndarray:
    """[identities] 0, 1 .. for the large components; others join the nearest large one in the first group with them."""
    from scipy.spatial import cKDTree

    counts = np.bincount(labels)
    large = np.flatnonzero(counts >= max(SHARE_LEAST * len(labels), 1))
    number = np.full(len(counts), -1)
    number[large] = np.arange(len(large))
    mine = number[labels]
    for g, own in zip(segment, ids, strict=True):
        middle, known = g.means[len(g.means) // 2], mine[own] >= 0
        if known.any() and not known.all():
            mine[own[~known]] = mine[own[known]][cKDTree(middle[known]).query(middle[~known])[1]]
    return np.maximum(mine, 0)


def _by_size(labels: list[np.ndarray]) -> np.ndarray:
    """[components] label: 0 for the component with the most Gaussians."""
    counts = np.bincount(np.concatenate(labels), minlength=1)
    rank = np.empty(len(counts), int)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(counts))
    return rank


def _by_place(labels: list[np.ndarray], segment: list[_Group], before: np.ndarray, known: np.ndarray) -> np.ndarray:
    """[components] label of most of the Gaussians `before` [M, 3], whose labels are `known` [M], that are nearest to
    the component in the first group that has it; `labels`: the components of the groups."""
    from scipy.spatial import cKDTree

    count = max(int(own.max(initial=0)) for own in labels) + 1
    tree, votes = cKDTree(before), np.zeros((count, int(known.max()) + 1), int)
    for g, own in zip(segment, labels, strict=True):
        new = ~votes.any(1)[own]
        np.add.at(votes, (own[new], known[tree.query(g.means[0][new])[1]]), 1)
    return votes.argmax(1)

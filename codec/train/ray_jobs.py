"""Training on a Ray cluster: one job per segment of `random_access` frames, the groups of a local run in its order.

A segment is an independent group and the groups that follow it, and depends on no other frames (train.py). A job opens
the capture by its path, so that the machines of the cluster must share the files. Needs the extra `ray`.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator

from ..errors import UsageError, require
from ..model.parametric_group import ParametricGroup
from ..model.rig import Rig
from .settings import TrainSettings
from .train import segments, train_groups

CPUS = 2  # of a job, and threads of its kernels: more segments in parallel gain more than more threads for one
RETRIES = 5  # of a segment whose worker died


def cluster_groups(
    address: str,
    open_capture: Callable,
    settings: TrainSettings,
    random_access: int,
    *,
    first_frame: int = 0,
    rig: Rig | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> Iterator[ParametricGroup]:
    """Yields the groups that `train_groups` yields.

    Args:
        address: of the cluster, as `ray.init` takes it ("auto", "ray://host:10001"); "local" starts one here.
        open_capture: () -> Capture, anywhere in the cluster.
        rig: predicts the motion in all frames of the capture.
        first_frame: where an earlier run stopped; the segment that it stopped in is trained again as a whole.
        on_progress: called with the number of frames done.

    Raises:
        UsageError: Ray is not installed, or the cluster cannot be reached or lost a segment again and again.
    """
    ray = require("ray", "training on a cluster", "ray")
    try:
        _knock(address)
        ray.init(address, log_to_driver=False, logging_level="ERROR")
    except (OSError, ValueError) as e:
        raise UsageError(f"--ray {address}: no cluster there ({e}); start one with: ray start --head") from e
    try:
        left = [s for s in segments(open_capture().frame_count, settings.gop, random_access) if s.stop > first_frame]
        cpus = int(min(CPUS, max(node["Resources"].get("CPU", 1) for node in ray.nodes())))
        threads = {"env_vars": {"RAYON_NUM_THREADS": str(cpus), "OMP_NUM_THREADS": "1"}}  # kernels, torch
        job = ray.remote(num_cpus=cpus, max_retries=RETRIES, runtime_env=threads)(train_segment)
        pending = [job.remote(open_capture, settings, random_access, s, rig) for s in left]
        for segment in left:
            done = segment.start
            for group in ray.get(pending.pop(0)):
                if done >= first_frame:
                    yield group
                done += len(group)
            if on_progress:
                on_progress(done)
    except ray.exceptions.RayTaskError as e:
        raise e.cause from None
    except ray.exceptions.RayError as e:  # a worker that dies again and again, no memory, a lost machine
        why = str(e).strip().splitlines()[0]
        raise UsageError(f"--ray {address}: the cluster failed ({why}); run the same command to go on") from e
    finally:
        ray.shutdown()  # ends running jobs


def _knock(address: str) -> None:
    """Raises OSError where no server answers; Ray itself would try for ten minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdigit():
        socket.create_connection((host, int(port)), timeout=10).close()


def train_segment(
    open_capture: Callable, settings: TrainSettings, random_access: int, frames: range, rig: Rig | None = None
) -> list[ParametricGroup]:
    """One job: the groups of a segment."""
    groups = train_groups(open_capture(), settings, first_frame=frames.start, random_access=random_access, rig=rig)
    done = frames.start
    found = []
    while done < frames.stop:
        found.append(next(groups))
        done += len(found[-1])
    return found

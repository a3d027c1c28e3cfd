"""Training on a local Ray cluster of two processors: the same bytes as a local run, also when a worker dies."""

import os
import signal

import interrupting
import pytest

from gscodec.capture import open_capture
from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import CaptureError, UsageError
from gscodec.train.ray_jobs import cluster_groups
from gscodec.train.settings import TrainSettings
from gscodec.train.train import train_groups

pytest.importorskip("ray", reason="Ray is not installed (pip install 'gscodec[ray]')")
TINY = TrainSettings(gop=2, **interrupting.TINY)
ACCESS = 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walking")
    interrupting.write_capture(folder, frames=5)
    return folder


def encoded(out, groups) -> bytes:
    config = stream_config(fps=25, sh_degree=0, gaussians=200, frames=2)
    encode_groups(groups, StreamOutput(out, config), EncodeSettings(random_access=ACCESS))
    return out.read_bytes()


def test_a_cluster_gives_the_bytes_of_a_local_run_though_a_worker_dies(folder, tmp_path):
    died, here = tmp_path / "died", os.getpid()

    def opened():
        if os.getpid() != here and not died.exists():
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return open_capture(folder)

    progress = []
    remote = encoded(
        tmp_path / "remote.gsv",
        lambda _, frames: cluster_groups("local", opened, TINY, ACCESS, on_progress=progress.append),
    )
    assert died.exists()
    assert progress == [2, 4, 5]
    local = encoded(
        tmp_path / "local.gsv", lambda _, frames: train_groups(open_capture(folder), TINY, random_access=ACCESS)
    )
    assert remote == local


def test_what_goes_wrong_there_is_said_here(folder):
    with pytest.raises(UsageError, match=r"--ray 127.0.0.1:1: no cluster there"):
        next(cluster_groups("127.0.0.1:1", lambda: open_capture(folder), TINY, ACCESS))
    here = os.getpid()

    def opened():
        if os.getpid() != here:
            raise CaptureError("cam3, frame 2: missing")
        return open_capture(folder)

    with pytest.raises(CaptureError, match=r"cam3, frame 2: missing$"):
        next(cluster_groups("local", opened, TINY, ACCESS))

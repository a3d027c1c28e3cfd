"""Draco point clouds: written and read back, also by the command line."""

import numpy as np
import pytest
from synthetic import blob
from test_cli import run

from gscodec.errors import CaptureError
from gscodec.splats import read_splat, write_splat


def test_points_survive_as_a_set(tmp_path):
    g = blob(300)
    write_splat(tmp_path / "a.drc", g)
    back = read_splat(tmp_path / "a.drc")
    distance = np.linalg.norm(g.means[:, None] - back.means[None], axis=2)
    step = np.ptp(g.means, axis=0).max() / (2**16 - 1)
    assert len(back) == 300
    assert distance.min(0).max() < step
    assert distance.min(1).max() < step
    assert np.isfinite(back.log_scales).all()


def test_stream_to_drc_and_back(tmp_path):
    write_splat(tmp_path / "a.drc", blob(50))
    assert run("encode", tmp_path / "a.drc", tmp_path / "a.gsv", "--keep-all", "--quality", 100).returncode == 0
    assert run("decode", tmp_path / "a.gsv", tmp_path / "points", "--format", "drc").returncode == 0
    assert len(read_splat(tmp_path / "points" / "000000.drc")) == 50


def test_what_is_no_draco_file_is_named(tmp_path):
    (tmp_path / "a.drc").write_bytes(b"not draco")
    with pytest.raises(CaptureError, match=r"a\.drc: not a Draco point cloud"):
        read_splat(tmp_path / "a.drc")

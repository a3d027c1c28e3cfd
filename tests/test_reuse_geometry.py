"""New colours over the geometry of a stream: bytes of geometry and motion stay, inputs that do not fit are named."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from synthetic import encode_sequence, turning
from trained import capture, load_groups

from bench.procedural import write_transforms
from gscodec.commands.reuse_geometry import encode_reusing
from gscodec.commands.sources import TrainOptions
from gscodec.decode import open_stream
from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
from gscodec.encode.recolor import COLORS
from gscodec.encode.settings import EncodeSettings
from gscodec.fit import fit_groups
from gscodec.metrics.image import psnr
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.progress import Bar
from gscodec.render.image import render_image
from gscodec.splats import read_splat, write_sequence, write_splat

COMMAND = "from gscodec.cli import main; main()"
GRADE = np.array([[0.2, 0.7, 0.1], [0.5, 0.3, 0.2], [0.1, 0.1, 0.9]])
FRAMES = 6


def run(*arguments):
    return subprocess.run([sys.executable, "-c", COMMAND, *map(str, arguments)], capture_output=True, text=True)


def small(grade=None):
    """The bundled capture at a quarter of its size, with its colours multiplied by the matrix `grade`."""
    plain = capture().scaled(0.25)

    def read(i, t):
        view = plain.view(i, t)
        return dataclasses.replace(view, rgb=np.rint((view.rgb @ grade.T).clip(0, 255)).astype(np.uint8))

    return plain if grade is None else dataclasses.replace(plain, read=read)


@pytest.fixture(scope="module", params=[1, 3], ids=["one layer", "layers"])
def old(request, tmp_path_factory):
    """A stream of two trained groups, of which the second one is predicted, with harmonics and lifetimes."""
    path = tmp_path_factory.mktemp("old") / "old.gsv"
    groups = load_groups()
    config = stream_config(
        fps=30, sh_degree=groups[0].canonical.sh_degree, gaussians=2000, frames=3, cameras=small().cameras
    )
    settings = EncodeSettings(quality=50, refine=0, layers=request.param)
    fitted = lambda _, __: fit_groups(groups, random_access=60)  # noqa: E731
    encode_groups(fitted, StreamOutput(path, config), settings)
    assert open_stream(path).group(1).reference == 1
    return path


@pytest.fixture(scope="module")
def plys(old, tmp_path_factory):
    """Folder with the frames of the stream in other colours."""
    folder = tmp_path_factory.mktemp("plys")
    write_sequence(open_stream(old).sequence(), folder)
    for path in folder.glob("*.ply"):
        write_splat(path, graded(read_splat(path)))
    return folder


def graded(g):
    sh0, shN = ((a @ GRADE.T).astype(np.float32) for a in (g.sh0, g.shN))
    return dataclasses.replace(g, sh0=sh0 + np.float32(0.1), shN=shN)


def geometry(path) -> list[dict]:
    """For each group: the bytes of every unit and stream without colours."""
    stream, found = open_stream(path), []
    for i in range(len(stream.groups)):
        payload, own = stream.payload(i), {}
        for u in stream.group(i).units():
            if u["type"] not in ("group_header", "tile") and u["attribute"] not in COLORS:
                key = u["type"], u["attribute"], u["layer"], u["tile"]
                own[key] = payload[u["offset"] : u["offset"] + u["bytes"]]
        found.append(own)
    return found


def shares_geometry(old, new):
    before, after = geometry(old), geometry(new)
    assert before == after
    assert {"positions", "channels", "trajectories", "node_trajectories"} <= {k[0] for k in before[0]}
    a, b = open_stream(old), open_stream(new)
    for t in range(FRAMES):
        x, y = a.frame(t), b.frame(t)
        for name in ("means", "quats", "log_scales", "logit_opacities"):
            np.testing.assert_array_equal(getattr(x, name), getattr(y, name))


def test_recoloured_splats_share_the_bytes_of_geometry(old, plys, tmp_path):
    new = tmp_path / "new.gsv"
    done = run("encode", plys, new, "--reuse-geometry", old)
    assert done.returncode == 0, done.stderr
    assert "bytes of colours are new, geometry and motion are of" in done.stdout
    shares_geometry(old, new)
    stream, camera = open_stream(new), small().cameras[0]
    was, wanted = open_stream(old), [graded(open_stream(old).frame(t)) for t in range(FRAMES)]
    for t in (0, 2, 5):
        picture = render_image(wanted[t], camera)
        assert psnr(picture, render_image(stream.frame(t), camera)) > 38
        assert psnr(picture, render_image(was.frame(t), camera)) < 30


class Stopped(Bar):
    """A progress bar that raises Ctrl-C after the first group."""

    def update(self, stage, done, total):
        raise KeyboardInterrupt


def test_a_stopped_run_goes_on_to_the_same_bytes(old, plys, tmp_path):
    def encode(bar, path):
        settings, options = EncodeSettings(), TrainOptions("medium", None, 30)
        return encode_reusing(plys, "splats", old, path, settings, options, bar)

    with Stopped() as bar:
        first = encode(bar, tmp_path / "a.gsv")
    assert first.interrupted
    assert open_stream(tmp_path / "a.gsv").frame_count == 3
    with Bar() as bar:
        assert [g["frame"] for g in encode(bar, tmp_path / "a.gsv").group_list] == [3]
        encode(bar, tmp_path / "b.gsv")
    assert (tmp_path / "a.gsv").read_bytes() == (tmp_path / "b.gsv").read_bytes()
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["a.gsv", "b.gsv"]


def test_a_placed_track_keeps_its_placement(old, plys, tmp_path):
    """Its splats are those without the placement."""
    placed, new = tmp_path / "placed.gsv", tmp_path / "new.gsv"
    assert run("edit", old, "-o", placed, "--track", "1:name=he:move=9,0,0").returncode == 0
    assert run("encode", plys, new, "--reuse-geometry", placed).returncode == 0
    assert open_stream(new).config["placement"] == open_stream(placed).config["placement"]
    shares_geometry(placed, new)
    assert run("decode", placed, tmp_path / "moved").returncode == 0
    done = run("encode", tmp_path / "moved", tmp_path / "no.gsv", "--reuse-geometry", placed)
    assert "of a placed track, with --track 1:transform=none" in done.stderr
    assert not list(tmp_path.glob("no.gsv*"))


def test_an_empty_group_stays_empty(tmp_path):
    groups = [DenseGroup([Gaussians.none()]), *turning(60, frames=2).groups]
    config = stream_config(fps=25, sh_degree=0, gaussians=60, frames=2)
    encode_sequence(GaussianSequence(25.0, groups), tmp_path / "a.gsv", config, EncodeSettings(refine=0))
    write_sequence(open_stream(tmp_path / "a.gsv").sequence(), tmp_path / "plys")
    with Bar() as bar:
        options = EncodeSettings(), TrainOptions("medium", None, 30), bar
        encode_reusing(tmp_path / "plys", "splats", tmp_path / "a.gsv", tmp_path / "b.gsv", *options)
    assert [len(open_stream(tmp_path / "b.gsv").frame(t)) for t in range(3)] == [0, 60, 60]


def test_a_capture_in_other_light_gives_its_colours(old, tmp_path):
    """The new colours come from the pictures, and are much nearer to them than those of the stream."""
    folder, new = tmp_path / "capture", tmp_path / "new.gsv"
    folder.mkdir()
    light = small(GRADE)
    write_transforms(light, folder)
    done = run("encode", folder, new, "--reuse-geometry", old, "--refine", 24)
    assert done.returncode == 0, done.stderr
    shares_geometry(old, new)
    i = light.indices("test")[0]
    view = light.view(i, 4)
    alpha = view.alpha[..., None] / 255
    picture = np.rint(view.rgb * alpha + 127.5 * (1 - alpha)).astype(np.uint8)
    before, after = (psnr(picture, render_image(open_stream(p).frame(4), light.cameras[i])) for p in (old, new))
    assert after > before + 3


def test_what_does_not_fit_is_said(old, plys, tmp_path):
    def says(message, *arguments):
        done = run("encode", *arguments, "--reuse-geometry", old)
        assert (done.returncode, done.stdout) == (1, ""), done.stderr
        assert message in done.stderr
        assert "Traceback" not in done.stderr

    out = tmp_path / "new.gsv"
    says("leave --quality away", plys, out, "--quality", 50)
    says("leave --preset away", plys, out, "--preset", "fast")
    says("leave --gop away", plys, out, "--gop", 7)
    says("leave --random-access away", plys, out, "--random-access", 4)
    says("--refine 7: colours are refined by the pictures of a capture", plys, out, "--refine", 7)
    says("expected as many", plys, out, "--frames", "0:5")
    says("the output is the stream whose geometry is reused", plys, old)
    fewer = tmp_path / "fewer"
    fewer.mkdir()
    frames = [read_splat(p) for p in sorted(plys.glob("*.ply"))]
    for t, g in enumerate(frames):
        write_splat(fewer / f"{t}.ply", g.take(np.arange(len(g) - 1)))
    says("in their order", fewer, out)
    for t, g in enumerate(frames):
        write_splat(fewer / f"{t}.ply", g.take(np.arange(len(g))[::-1]))
    says("is not where the stream has it", fewer, out)
    folder = tmp_path / "capture"
    folder.mkdir()
    away = small()
    shifted = np.eye(4)
    shifted[0, 3] = 0.2
    cameras = [
        dataclasses.replace(c, viewmat=shifted @ c.viewmat if i == 2 else c.viewmat) for i, c in enumerate(away.cameras)
    ]
    write_transforms(dataclasses.replace(away, cameras=cameras, poses=None), folder)
    says(f"camera {cameras[2].name} is not where", folder, out)
    assert not list(tmp_path.glob("new.gsv*"))

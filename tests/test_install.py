"""The wheel in a foreign folder, in an environment for playback: numpy, typer and rich, without extras."""

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest
from synthetic import encode_sequence, turning

from gscodec.splats import write_sequence

ROOT = Path(__file__).parent.parent
# Without the variables that would put another gscodec before the wheel's.
OUTSIDE = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}


@pytest.fixture(scope="module")
def player(tmp_path_factory):
    """Folder with a venv that has the wheel, and a stream."""
    from gscodec.encode.encode import stream_config

    path = tmp_path_factory.mktemp("player")
    subprocess.run(["make", "-s", "wheel", f"PYTHON={sys.executable}", f"DIST={path}"], cwd=ROOT, check=True)
    venv.create(path / "env", with_pip=True)
    wheel = next(path.glob("gscodec-*.whl"))
    no_rust = OUTSIDE | {"PATH": f"{path}/env/bin:/usr/bin:/bin"}
    subprocess.run([path / "env/bin/python", "-m", "pip", "install", "-q", wheel], check=True, env=no_rust)
    sequence = turning(100, frames=3)
    write_sequence(sequence, path / "plys")
    encode_sequence(sequence, path / "a.gsv", stream_config(fps=25, sh_degree=0, gaussians=100, frames=6))
    return path


def run(player, *args):
    """Runs the program of the wheel."""
    return subprocess.run([player / "env/bin/gscodec", *args], cwd=player, capture_output=True, text=True, env=OUTSIDE)


def python(player, *args):
    """Runs the interpreter that has the wheel."""
    return subprocess.run([player / "env/bin/python", *args], cwd=player, capture_output=True, text=True, env=OUTSIDE)


def test_the_environment_has_none_of_the_extra(player):
    listed = python(player, "-m", "pip", "list").stdout.lower()
    for name in ("torch", "opencv", "openimageio", "scikit-image", "dracopy", "imageio", "scipy"):
        assert name not in listed


def test_it_decodes_renders_and_tells(player):
    assert "3 frames" in run(player, "info", "a.gsv").stdout
    done = run(player, "decode", "a.gsv", "out")
    assert done.returncode == 0, done.stderr
    assert len(list((player / "out").glob("*.ply"))) == 3
    done = run(player, "render", "a.gsv", "png", "--size", "32x32")
    assert done.returncode == 0, done.stderr
    assert len(list((player / "png").glob("*.png"))) == 3


def test_it_plays(player):
    code = """
import http.client, pathlib, threading
from gscodec.player.server import FILES, Server
server = Server(pathlib.Path("a.gsv"))
threading.Thread(target=server.serve_forever, daemon=True).start()
for name in (*FILES, "stream.gsv"):
    c = http.client.HTTPConnection(*server.server_address)
    c.request("GET", "/" + name)
    r = c.getresponse()
    assert r.status == 200 and r.read(), name
"""
    done = python(player, "-c", code)
    assert done.returncode == 0, done.stderr


def test_benchmarks_ask_for_a_checkout(player):
    for args in (("bench", "raster"), ("bench", "rd"), ("chart",)):
        result = run(player, *args)
        assert result.returncode == 1, args
        assert "clone the repository" in result.stderr, (args, result.stderr)
        assert "Traceback" not in result.stderr


def test_the_studios_commands_name_the_extra(player):
    (player / "capture").mkdir(exist_ok=True)
    (player / "capture" / "transforms.json").write_text("{}")
    for args in (
        ("render", "a.gsv", "a.mp4"),
        ("encode", "capture", "b.gsv"),
        ("encode", "plys", "b.gsv"),
        ("train", "capture", "trained"),
    ):
        result = run(player, *args)
        assert result.returncode == 1, args
        assert "gscodec[encode]" in result.stderr, (args, result.stderr)
        assert "Traceback" not in result.stderr

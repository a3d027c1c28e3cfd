"""The player's page and groups of many tiles: shared by workers, headers of any length, decoding by view."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playing import FPS, LENGTH, PLAYER, canvas, load, psnr, sequence, show
from quantized_groups import surface_group
from synthetic import encode_sequence
from test_player import run_wasm

from gscodec import _native
from gscodec.decode import open_scene, open_stream
from gscodec.decode.scene import Track
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.encode.tracks import TrackPlan, write_tracks
from gscodec.encode.writer import StreamWriter
from gscodec.model.camera import Camera, look_at
from gscodec.model.placement import Placement
from gscodec.model.rotations import rotvec_to_quat
from gscodec.render.image import render_image

LEVEL, SIDE = 4, 4  # log2 of the side of a tile
HEAD = 1 << 16  # bytes that the page reads first of any file
UP = np.array([0, 1.0, 0])


@pytest.fixture(scope="module")
def tiled(tmp_path_factory) -> Path:
    """Five groups of two layers in tiles of 256 Gaussians; all but the first and the fourth group are predicted."""
    folder = tmp_path_factory.mktemp("tiles")
    s, same = sequence(4000), np.arange(4000, dtype=np.int32)
    s = s.with_groups([replace(g, parents=same if k else None) for k, g in enumerate(s.groups)])
    config = stream_config(fps=FPS, sh_degree=0, gaussians=4000, frames=LENGTH)
    settings = EncodeSettings(quality=80, layers=2, random_access=3 * LENGTH)
    encode_sequence(s, folder / "whole.gsv", config, settings)
    stream, writer, reference = open_stream(folder / "whole.gsv"), StreamWriter(folder / "tiled.gsv", config, {}), None
    for i, g in enumerate(stream.groups):
        q = replace(stream.group(i).quantized(), tile_side_log2=SIDE)
        reference = None if g["sync"] else reference
        payload = _native.encode_group(q, reference)[0]
        writer.append(payload, g["frames"], sync=g["sync"])
        if g["sync"]:
            reference = _native.DecodedGroup(payload, LEVEL)
    writer.finish()
    return folder / "tiled.gsv"


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_workers_share_a_group(browser, server, other, tiled, workers):
    """The picture is that of the whole group, predicted or not, for any number of workers."""
    url, _ = other(tiled.read_bytes())
    load(browser, server.url, src=url, size="160x120", autoplay="off", loop="off", layers="all")
    browser.eval(f"{PLAYER}.engine.shares = {workers}, {PLAYER}.engine.forget()")
    stream = open_stream(tiled)
    for t in (4 * LENGTH + 1, LENGTH + 2, 0):  # predicted, predicted, independent
        camera = show(browser, t)
        want = render_image(stream.frame(t), camera, tuple(stream.config["background"]))
        assert psnr(canvas(browser), want) >= 35, t
        assert browser.eval(f"{PLAYER}.engine.groups.get({t // LENGTH}).pieces") == workers
        assert browser.eval(f"{PLAYER}.stats.gaussians") == len(stream.frame(t))
    assert browser.errors == []


def test_a_group_of_thousands_of_tiles(browser, server, other, tmp_path):
    """The header of a group may be as long as its tiles need; an impossible length is refused."""
    group = replace(surface_group(300_000), tile_side_log2=SIDE)
    writer = StreamWriter(tmp_path / "a.gsv", stream_config(fps=25, sh_degree=0, gaussians=300_000, frames=1), {})
    writer.append(_native.encode_group(group)[0], 1)
    writer.finish()
    url, _ = other((tmp_path / "a.gsv").read_bytes())
    browser.goto(server.url + "?src=none.gsv")
    body = """
        const index = native.index(payload(groups[0]));
        const back = native.reference(payload(groups[0]));
        const shown = native.decode(0, payload(groups[0]), config.level).gaussians;
        const long = payload(groups[0]);
        long[0] = 1;
        let message = "";
        try { native.reference(long); } catch (e) { message = e.message; }
        return [index.tiles[0].length, index.header, index.size === groups[0].size, back, shown, message];
    """
    tiles, header, whole, back, shown, message = run_wasm(browser, url, body)
    assert (tiles, whole, back, shown) == (1172, True, 0, 300_000)
    assert header > 1 << 14
    assert "expected at most 4194304" in message


# whether the tiles of a group of each track that are in view are decoded
ALL_THERE = f"""(({{ engine }}) => (engine.scene?.tracks ?? [{{ engine }}]).every(({{ engine }}) => {{
    const {{ content, flags, left, layers }} = engine.groups.get(GROUP);
    return !left && content.seen(engine.sight(), layers).every((seen, j) => !seen || flags[j]);
}}))({PLAYER})"""


def open_partly(browser, server, url: str) -> None:
    """Opens a stream so that the page fetches only tiles in view, also of a small file."""
    browser.goto(f"{server.url}?autoplay=off&loop=off&layers=all&size=160x120")
    browser.eval(f"{PLAYER}.engine.constructor.partly = 0")
    browser.eval(f"{PLAYER}.setAttribute('camera', 'first'), {PLAYER}.setAttribute('src', {json.dumps(url)})")
    browser.wait(f"{PLAYER}.camera && {PLAYER}.stats.gaussians > 0")


def compare(browser, stream, t: int, camera: Camera) -> int:
    """Compares a picture by `camera` with that of the whole group, after all tiles in view are decoded; returns the
    number of decoded Gaussians."""
    k = [camera.K[i] for i in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2))]
    c = {"width": camera.width, "height": camera.height, "near": 0.01, "low_pass": 0.3, "k": k}
    c |= {"viewmat": camera.viewmat[:3].flatten().tolist()}
    browser.eval(f"{PLAYER}.camera.reference = {json.dumps(c)}")
    show(browser, t)
    browser.wait(ALL_THERE.replace("GROUP", str(t // LENGTH)))
    show(browser, t)
    want = render_image(stream.frame(t), camera, tuple(stream.config["background"]))
    assert want.std() > 5
    assert psnr(canvas(browser), want) >= 40, t
    return browser.eval(f"{PLAYER}.stats.gaussians")


def test_only_the_tiles_in_view_are_decoded(browser, server, other, tiled):
    """Predicted and independent groups; when the view turns, the new tiles in view are added."""
    stream, (url, _) = open_stream(tiled), other(tiled.read_bytes())
    open_partly(browser, server, url)
    means = stream.frame(0).means
    K = np.array([[900.0, 0, 80], [0, 900, 60], [0, 0, 1]])
    ends = means[means[:, 0].argmin()], means[means[:, 0].argmax()]
    views = [Camera("", K, look_at(e - [0, 0, 5], e, UP), 160, 120) for e in ends]
    for t in (4 * LENGTH + 1, LENGTH + 2, 3 * LENGTH):  # predicted, predicted, independent
        some, more = (compare(browser, stream, t, view) for view in views)
        assert some < more <= len(stream.frame(t))
    assert browser.errors == []


def test_of_the_tracks_of_a_scene_only_the_tiles_in_view_are_decoded(browser, server, other, tiled, tmp_path):
    """Tiles of each track are chosen by the view of the placed track; its transform moves every piece."""
    key = (0, tuple(rotvec_to_quat(np.array([0, 0.5, 0.3])).tolist()), (3.0, 0.5, 0.0), 0.5)
    placements = Placement("one"), Placement("other", keys=(key, (60, (1.0, 0.0, 0.0, 0.0), (-3.0, 0.0, 1.0), 0.8)))
    stream = open_scene(tiled).tracks[0].stream
    write_tracks(tmp_path / "scene.gsv", [TrackPlan.of(Track(stream, placement)) for placement in placements])
    scene, (url, _) = open_scene(tmp_path / "scene.gsv"), other((tmp_path / "scene.gsv").read_bytes())
    open_partly(browser, server, url)
    K = np.array([[900.0, 0, 80], [0, 900, 60], [0, 0, 1]])
    for t in (4 * LENGTH + 1, LENGTH + 2, 3 * LENGTH):  # predicted, predicted, independent
        means = scene.frame(t).means
        ends = means[means[:, 0].argmin()], means[means[:, 0].argmax()]
        some, more = (compare(browser, scene, t, Camera("", K, look_at(e - [0, 0, 5], e, UP), 160, 120)) for e in ends)
        assert some < more <= len(means), t
    assert browser.errors == []


def test_only_the_tiles_in_view_are_fetched(browser, server, other, tmp_path):
    """A camera inside a hollow ball: few bytes for a view, as many more for the opposite view, none for fetched
    tiles."""
    group = surface_group(80_000)
    small = replace(group.channels["log_scales"], steps=np.full(3, 0.1, np.float32))
    group = replace(group, tile_side_log2=SIDE, channels=group.channels | {"log_scales": small})
    middle = group.origin + 128
    views = [
        Camera("first", np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]]), look_at(middle, middle + d, UP), 160, 120)
        for d in ([1.0, 0, 0], [-1.0, 0, 0])
    ]
    path = tmp_path / "ball.gsv"
    writer = StreamWriter(path, stream_config(fps=25, sh_degree=0, gaussians=80_000, frames=1, cameras=views[:1]), {})
    writer.append(_native.encode_group(group)[0], 1)
    writer.finish()
    stream, (url, handler) = open_stream(path), other(path.read_bytes())
    open_partly(browser, server, url)
    counts, fetched = [], []
    for view in (*views, views[0]):
        counts.append(compare(browser, stream, 0, view))
        asked = [tuple(map(int, value[6:].split("-"))) for value in handler.log]
        fetched.append(sum(end + 1 - start for start, end in asked) / path.stat().st_size)
    assert counts[0] < 0.2 * 80_000
    assert fetched[0] < 0.2 + HEAD / path.stat().st_size
    assert counts[0] < counts[1] < 0.4 * 80_000
    assert fetched[0] + 0.05 < fetched[1] < fetched[0] + 0.2
    assert fetched[2] < fetched[1] + 0.1, "what is here is not fetched again"
    assert browser.errors == []

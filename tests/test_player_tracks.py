"""The page with a scene of several tracks: picture against the renderer, hiding in the list, damage to one track."""

import dataclasses

import numpy as np
import pytest
from playing import FPS, LENGTH, PLAYER, canvas, error_text, load, notes, part, psnr, sequence, show
from synthetic import encode_sequence

from gscodec.decode import open_scene
from gscodec.decode.scene import Scene, Track
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.encode.tracks import TrackPlan, write_tracks
from gscodec.model.placement import Placement
from gscodec.model.rotations import rotvec_to_quat
from gscodec.render.image import render_image

PATH = [
    (0, tuple(rotvec_to_quat(np.array([0, 0.5, 0.3])).tolist()), (1.2, 0.5, 0.0), 0.5),
    (60, (1.0, 0.0, 0.0, 0.0), (-1.2, 0.5, 0.0), 0.8),
]


@pytest.fixture(scope="module")
def scene(gsv, tmp_path_factory):
    """The stream of the other tests, and a moving ball at half its frame rate that starts 0.2 s late and repeats
    endlessly."""
    folder = tmp_path_factory.mktemp("scene")
    own = dataclasses.replace(sequence(150, sh_count=3), fps=FPS / 2)
    config = stream_config(fps=FPS / 2, sh_degree=1, gaussians=150, frames=LENGTH)
    encode_sequence(own, folder / "ball.gsv", config, EncodeSettings(quality=80))
    ball = Placement("ball", offset=3, repeats=0, keys=tuple(PATH))
    man, other = (open_scene(path).tracks[0] for path in (gsv, folder / "ball.gsv"))
    plans = [TrackPlan.of(Track(man.stream, Placement("man"))), TrackPlan.of(Track(other.stream, ball))]
    write_tracks(folder / "scene.gsv", plans)
    return folder / "scene.gsv"


def expected(path, t, camera, hidden=()):
    s = open_scene(path)
    tracks = [Track(x.stream, dataclasses.replace(x.placement, hidden=x.placement.name in hidden)) for x in s.tracks]
    return render_image(Scene(tracks).frame(t), camera, tuple(s.config["background"]))


def choose(browser, i, on):
    box = f"{part('.tracks')}.querySelectorAll('input')[{i}]"
    browser.eval(f"({box}.checked = {str(on).lower()}, {box}.dispatchEvent(new Event('change', {{ bubbles: true }})))")


def test_the_scene_is_that_of_the_renderer(browser, server, other, scene):
    url, _ = other(scene.read_bytes())
    load(browser, server.url, src=url, size="320x200", autoplay="off")
    assert browser.eval(f"{part('.tracks')}.innerText").split() == ["man", "ball"]
    assert browser.eval(f"{PLAYER}.frameCount") == open_scene(scene).frame_count == 60 + 6
    assert browser.eval(f"{PLAYER}.stats.received > {PLAYER}.engine.source.received"), "of both tracks"
    for t in (0, 7, 25, 35):  # without the ball, with both, after the end of the man
        camera = show(browser, t)
        want = expected(scene, t, camera)
        assert want.std() > 5
        assert psnr(canvas(browser), want) >= 35
    camera = show(browser, 20)
    for hidden in (["man"], ["man", "ball"], ["ball"], []):
        for i, name in enumerate(("man", "ball")):
            choose(browser, i, name not in hidden)
        show(browser, 20)
        assert psnr(canvas(browser), expected(scene, 20, camera, hidden) if len(hidden) < 2 else blank(scene)) >= 35
    browser.eval(f"{part('.tracks input')}.focus()")
    browser.key(" ")
    assert browser.eval(f"!{part('.tracks input')}.checked && {PLAYER}.paused"), "space is the key of the checkbox"
    assert browser.errors == []


def blank(path):
    background = np.array(open_scene(path).config["background"])
    return np.broadcast_to((background * 255 + 0.5).astype(np.uint8), (200, 320, 3))


def test_damage_to_a_track_leaves_the_other(browser, server, other, scene):
    opened, data = open_scene(scene), bytearray(scene.read_bytes())
    g = opened.tracks[1].stream.groups[1]
    data[g["offset"] + g["size"] - 5] ^= 0xFF
    url, _ = other(bytes(data))
    load(browser, server.url, src=url, size="320x200", autoplay="off")
    t = 6 + 2 * (LENGTH + 1)
    camera = show(browser, t)
    assert psnr(canvas(browser), expected(scene, t, camera, ["ball"])) >= 35
    assert "damaged" in notes(browser)


@pytest.mark.parametrize("groups", [1, None])
def test_damage_where_nothing_else_is_shown(browser, server, other, scene, groups):
    """The first group of the first track, before the other one starts; None: all groups of both."""
    data = bytearray(scene.read_bytes())
    for track in open_scene(scene).tracks[:groups]:
        for g in track.stream.groups[:groups]:
            data[g["offset"] + g["size"] - 5] ^= 0xFF
    url, _ = other(bytes(data))
    if groups:
        load(browser, server.url, src=url, size="64x64")
        browser.wait(f"{PLAYER}.frame > {LENGTH}")
        assert f"Frames 0–{LENGTH - 1} are damaged" in notes(browser)
    else:
        browser.goto(f"{server.url}?src={url}")
        assert "None of its groups can be decoded" in error_text(browser)


def test_no_worker_outlives_a_scene_that_is_closed_while_it_opens(browser, server, other, scene):
    load(browser, server.url, size="64x64")
    url, _ = other(scene.read_bytes(), rate=60_000)
    script = f"""new Promise((done) => {{
        const [player, alive] = [{PLAYER}, new Set()];
        window.Worker = class extends Worker {{
            constructor(...how) {{ super(...how); alive.add(this); }}
            terminate() {{ alive.delete(this); super.terminate(); }}
        }};
        player.setAttribute("src", "{url}");
        const look = () => {{
            if (!player.engine.scene) return setTimeout(look, 5);
            const {{ opened }} = player.engine.scene;
            player.remove();
            done([opened, alive.size]);
        }};
        look();
    }})"""
    assert browser.eval(script) == [False, 0]

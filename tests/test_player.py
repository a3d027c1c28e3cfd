"""The player's page in a real Chromium: picture, controls, and decoder against the native one."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playing import FPS, GROUPS, LENGTH, PLAYER, canvas, load, part, psnr, screenshot, sequence, show
from synthetic import encode_sequence

from gscodec import _native
from gscodec.decode import open_stream
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.encode.writer import layer_ends
from gscodec.model.camera import Camera, look_at
from gscodec.render.image import render_image

HEAD = 400  # bytes of a fragment before its payload, at most
VECTORS = Path(__file__).parent.parent / "spec" / "vectors" / "valid"


def test_the_picture_is_that_of_the_renderer(browser, server, gsv):
    load(browser, server.url, size="320x200", autoplay="off")
    stream = open_stream(gsv)
    background = tuple(stream.config["background"])
    for t in (0, LENGTH + 5, 3 * LENGTH + 1):  # with lifetimes and without
        camera = show(browser, t)
        assert (camera.width, camera.height) == (320, 200)
        want = render_image(stream.frame(t), camera, background)
        got = canvas(browser)
        assert want.std() > 10
        assert psnr(got, want) >= 35
        assert np.abs(got.astype(int) - want).max() <= 2
        assert psnr(screenshot(browser, part("canvas")), want) >= 35
    assert browser.errors == []


def test_reference_cameras(browser, server, gsv):
    load(browser, server.url, size="256x192", autoplay="off")
    options = browser.eval(f"[...{part('[data-set=view]')}.options].map((o) => o.text)")
    assert options == ["Free view", "cam0", "cam1"]
    browser.eval(f"{PLAYER}.camera.use(1)")
    show(browser, 2)
    stream = open_stream(gsv)
    want = render_image(stream.frame(2), stream.cameras[1], tuple(stream.config["background"]))
    assert psnr(canvas(browser), want) >= 35
    before = browser.eval(f"Array.from({PLAYER}.camera.view(256, 192))")
    browser.eval(f"{PLAYER}.camera.orbit(0, 0)")  # a drag starts from this view
    after = browser.eval(f"Array.from({PLAYER}.camera.view(256, 192))")
    np.testing.assert_allclose(np.array(after)[6:18], np.array(before)[6:18], atol=2e-3)


def test_a_view_from_where_a_camera_stood_is_never_empty(browser, server, other, tmp_path):
    """Cameras amid the Gaussians: their pictures, and those of the free view that starts from them."""
    K, magenta = np.array([[90.0, 0, 80], [0, 90, 60], [0, 0, 1]]), (1.0, 0.0, 1.0)
    eyes = ([0.0, 0, 0], [0.3, 0.2, -0.4])
    views = [look_at(np.array(e), np.add(e, [1, 0.1, 0.3]), np.array([0, 1.0, 0])) for e in eyes]
    inside = [
        Camera("in0", K, views[0], 160, 120, near=0.005, low_pass=0.1),
        Camera("in1", K, views[1], 160, 120, near=0.05, low_pass=2.0),
    ]
    path = tmp_path / "inside.gsv"
    config = stream_config(fps=FPS, sh_degree=0, gaussians=4000, frames=LENGTH, cameras=inside, background=magenta)
    encode_sequence(sequence(4000), path, config, EncodeSettings(quality=70))
    stream = open_stream(path)
    empty = lambda picture: (np.abs(picture.astype(int) - [255, 0, 255]).max(-1) < 3).mean()  # noqa: E731
    for i, camera in enumerate(stream.cameras):
        url, _ = other(path.read_bytes())
        load(browser, server.url, src=url, size="160x120", autoplay="off", camera=f"in{i}")
        assert browser.eval(f"{part('[data-set=view]')}.selectedOptions[0].text") == f"in{i}"
        seen = show(browser, 2)
        assert (seen.near, seen.low_pass) == pytest.approx((camera.near, camera.low_pass))
        want = render_image(stream.frame(2), camera, magenta)
        assert empty(want) < 0.2
        assert psnr(canvas(browser), want) >= 35
        browser.eval(f"{PLAYER}.camera.orbit(0, 0)")
        free = show(browser, 2)
        assert free.near <= camera.near
        assert free.low_pass == pytest.approx(0.1), "that of the first camera"
        assert empty(canvas(browser)) < 0.2


def test_background_and_controls_of_a_page_that_embeds_it(browser, server):
    load(browser, server.url, size="160x120", autoplay="off", background="20c040", controls="off")
    show(browser, 0)
    assert canvas(browser)[0, 0].tolist() == [0x20, 0xC0, 0x40]
    assert browser.eval(f"getComputedStyle({part('.bar')}).display") == "none"


def test_the_address_sets_the_attributes_of_the_player_only(browser, server):
    load(browser, server.url, onfocus="document.title='owned'", muted="off", autoplay="off", size="0x0")
    assert set(browser.eval(f"{PLAYER}.getAttributeNames()")) == {"loop", "size", "src", "tabindex"}
    assert browser.eval("document.title") == "gscodec player"


def test_show_waits_for_the_file_and_refuses_what_it_does_not_have(browser, server):
    load(browser, server.url, size="64x64", autoplay="off")
    assert browser.eval(f"({PLAYER}.setAttribute('src', 'stream.gsv?2'), {PLAYER}.show(7).then((d) => d.t))") == 7
    for t in (-1, GROUPS * LENGTH):
        told = browser.eval(f"{PLAYER}.show({t}).catch((e) => e.message)")
        assert told == f"There is no frame {t}: expected 0 to {GROUPS * LENGTH - 1}."


def test_it_plays_loops_and_ends(browser, server):
    load(browser, server.url, size="160x120")
    browser.wait(f"{PLAYER}.frame > {LENGTH + 2}")
    browser.wait(f"{PLAYER}.frame < {LENGTH}")  # loops
    assert not browser.eval(f"{PLAYER}.paused")
    browser.eval(f"{PLAYER}.removeAttribute('loop')")
    browser.wait(f"{PLAYER}.paused")
    assert browser.eval(f"{PLAYER}.frame") == GROUPS * LENGTH - 1
    browser.eval(f"{PLAYER}.play()")
    browser.wait(f"{PLAYER}.frame < 5")
    assert browser.errors == []


def test_keys_and_buttons(browser, server):
    load(browser, server.url, size="160x120", autoplay="off")
    frame = lambda: browser.eval(f"{PLAYER}.frame")  # noqa: E731
    show(browser, 7)
    browser.key("ArrowRight")
    assert frame() == 8
    browser.key("ArrowLeft")
    browser.key("ArrowLeft")
    assert frame() == 6
    browser.key("End")
    assert frame() == GROUPS * LENGTH - 1
    browser.key("Home")
    assert frame() == 0
    browser.key(" ")
    assert not browser.eval(f"{PLAYER}.paused")
    browser.key(" ")
    assert browser.eval(f"{PLAYER}.paused")
    looping = browser.eval(f"{PLAYER}.loop")
    browser.key("l")
    assert browser.eval(f"{PLAYER}.loop") != looping
    browser.key("s")
    assert "Gaussians" in browser.wait(f"{part('.stats')}.textContent")
    browser.eval(f"{part('[data-do=play]')}.click()")
    assert not browser.eval(f"{PLAYER}.paused")
    speed = part("[data-set=speed]")
    browser.eval(f"{speed}.value = '2'; {speed}.dispatchEvent(new Event('change', {{bubbles: true}}))")
    assert browser.eval(f"{PLAYER}.speed") == 2


def test_drags_turn_move_and_zoom(browser, server):
    load(browser, server.url, autoplay="off")
    view = lambda: browser.eval(f"Array.from({PLAYER}.camera.view(100, 100)).slice(6, 18)")  # noqa: E731
    start = view()
    browser.drag((600, 300), (700, 340))
    turned = view()
    assert np.abs(np.subtract(turned, start)).max() > 0.1
    browser.drag((600, 300), (700, 340), "right")
    panned = np.array(view()).reshape(3, 4)
    np.testing.assert_allclose(panned[:, :3], np.array(turned).reshape(3, 4)[:, :3], atol=1e-6)
    assert abs(panned[0, 3] - turned[3]) > 0.1
    depth = panned[2, 3]
    browser.wheel(600, 300, -300)
    browser.wait(f"{PLAYER}.camera.view(9, 9)[17] < {depth - 0.1}")
    browser.eval(f"{part('[data-do=reset]')}.click()")
    np.testing.assert_allclose(view(), start, atol=1e-6)


def test_fingers_turn_move_and_zoom(browser, server):
    try:
        browser.resize(390, 844, mobile=True)
        load(browser, server.url, autoplay="off")
        view = lambda: np.array(browser.eval(f"Array.from({PLAYER}.camera.view(100, 100)).slice(6, 18)")).reshape(3, 4)  # noqa: E731
        start = view()
        browser.fingers([(150, 300), (200, 310), (260, 320)])
        turned = view()
        assert np.abs(turned[:, :3] - start[:, :3]).max() > 0.1
        browser.fingers([(150, 300), (100, 300)], [(200, 300), (250, 300)])  # fingers move apart
        near = view()
        np.testing.assert_allclose(near[:, :3], turned[:, :3], atol=1e-6)
        assert near[2, 3] < turned[2, 3] / 2
        browser.fingers([(150, 300), (150, 360)], [(200, 300), (200, 360)])  # both fingers move down
        assert view()[1, 3] > near[1, 3] + 0.05
        assert browser.eval("visualViewport.scale") == 1, "the page itself does not zoom"
    finally:
        browser.resize(1280, 800)


def test_scrubbing_shows_the_frame(browser, server, gsv):
    load(browser, server.url, size="160x120", autoplay="off")
    stream = open_stream(gsv)
    r = np.random.default_rng(1)
    for t in r.integers(0, GROUPS * LENGTH, 8).tolist():
        want = render_image(stream.frame(t), show(browser, t), tuple(stream.config["background"]))
        assert psnr(canvas(browser), want) >= 35, t
    bar = part(".seek input")
    browser.eval(f"{bar}.value = 20; {bar}.dispatchEvent(new Event('input', {{bubbles: true}}))")
    assert browser.eval(f"{PLAYER}.frame") == 20


def test_a_phone(browser, server):
    try:
        browser.resize(390, 844, mobile=True, scale=2)
        load(browser, server.url)
        assert browser.eval("document.documentElement.scrollWidth") <= 390
        for name in ("play", "loop", "reset", "stats"):
            box = f"{part(f'[data-do={name}]')}.getBoundingClientRect()"
            x, y, w, h = browser.eval(f"(({{x, y, width, height}}) => [x, y, width, height])({box})")
            assert x >= 0
            assert x + w <= 390
            assert y + h <= 844
            assert min(w, h) >= 36
    finally:
        browser.resize(1280, 800)


def test_predicted_groups_and_their_layers(browser, server, other, tmp_path):
    s = sequence(4000)
    same = np.arange(4000, dtype=np.int32)
    s = s.with_groups([replace(g, parents=same if k else None) for k, g in enumerate(s.groups)])
    path = tmp_path / "layers.gsv"
    config = stream_config(fps=FPS, sh_degree=0, gaussians=4000, frames=LENGTH)
    settings = EncodeSettings(quality=90, layers=3, random_access=3 * LENGTH)
    encode_sequence(s, path, config, settings)
    stream = open_stream(path)
    assert [g["sync"] for g in stream.groups] == [True, False, False, True, False]
    url, handler = other(path.read_bytes())
    load(browser, server.url, src=url, size="160x120", autoplay="off", loop="off", layers="1")

    def compare(stream, t):
        camera = show(browser, t)
        want = render_image(stream.frame(t), camera, tuple(stream.config["background"]))
        assert psnr(canvas(browser), want) >= 35, t

    for t in (4 * LENGTH + 1, LENGTH, 2 * LENGTH + 3):  # references come earlier
        compare(open_stream(path, layers=1), t)
    asked = [tuple(map(int, value[6:].split("-"))) for value in handler.log][1:]
    fetched = set().union(*(range(a, b + 1) for a, b in asked))  # a busy machine may ask for a range twice
    data = path.read_bytes()
    first = sum(layer_ends(_native.units(data[g["offset"] : g["offset"] + g["size"]]))[0] for g in stream.groups)
    assert len(fetched) < first + HEAD * len(stream.groups) < len(data) / 2
    browser.eval(f"{PLAYER}.setAttribute('layers', 'all')")
    for t in (2 * LENGTH + 3, 0, 4 * LENGTH):
        compare(stream, t)
    browser.eval(f"""(() => {{
        {PLAYER}.setAttribute('layers', '1');
        const post = Worker.prototype.postMessage;
        Worker.prototype.postMessage = function (m, ...rest) {{
            post.call(this, m, ...rest);
            if (m?.type === "decode" && m.group === 2) {PLAYER}.setAttribute('layers', 'all');
        }};
    }})()""")
    compare(stream, 2 * LENGTH + 3)  # the number of layers changes while the group is decoded
    assert browser.errors == []


def test_layers_follow_the_device(browser, server):
    """Fewer layers after several slow measurements in a row, more again after a while."""
    browser.goto(server.url + "?src=none.gsv")
    script = """(async () => {
        const { constructor: LayerChoice } = document.querySelector("gsv-player").engine.choice;
        const choice = new LayerChoice();
        const rates = [1, 2, 3];
        const after = (load, times, now) => {
            for (let i = 0; i < times; i++) choice.look(load, 3, now);
            return choice.choose(rates, 0);
        };
        return [
            choice.choose(rates, 0), choice.choose(rates, 2.6), choice.choose(rates, 0.1), choice.reason,
            choice.choose(rates, 100), choice.choose(rates, 100), choice.reason,
            after(1.5, 2, 0), after(0.7, 1, 0), after(1.5, 3, 0), choice.reason, after(1.5, 9, 0),
            after(0.3, 1, 9000), after(0.3, 1, 100000), after(0.3, 1, 110000), after(0.3, 1, 200000),
        ];
    })()"""
    link, device = "the link carries", "this device draws"
    assert browser.eval(script) == [3, 2, 1, link, 2, 3, None, 3, 3, 2, device, 1, 1, 2, 2, 3]


# The wasm module alone, without the page

INSTANCE = """
const { Native, load } = await import("/native.js");
const native = await Native.create(await load(new URL("/native.wasm.gz", location.href)));
const file = new Uint8Array(await (await fetch(SRC)).arrayBuffer());
native.push(file);
const { config, groups } = native.describe();
const payload = (g) => file.slice(g.offset, g.offset + g.size);
const base64 = (bytes) => {
    let s = "";
    for (let i = 0; i < bytes.length; i += 8192) s += String.fromCharCode(...bytes.subarray(i, i + 8192));
    return btoa(s);
};
"""


def run_wasm(browser, src: str, body: str):
    """Value that `body` returns, with `native`, `config`, `groups` and `payload` of the file at `src`."""
    return browser.eval(f"(async () => {{ {INSTANCE.replace('SRC', json.dumps(src))} {body} }})()")


def test_every_vector_decodes_to_the_frames_of_the_native_decoder(browser, server, other):
    browser.goto(server.url + "?src=none.gsv")
    body = """
        const out = [];
        for (const [i, g] of groups.entries()) {
            const back = native.reference(payload(g));
            native.decode(i, payload(g), config.level, back ? { reference: i - back } : {});
            native.frame(i, g.frames >> 1);
            for (let a = 0; a < 6; a++) { native.x.attribute(a); out.push(base64(native.output())); }
        }
        return [out, native.describe()];
    """
    paths = sorted(VECTORS.glob("*.gsv"))
    assert len(paths) > 20
    for path in paths:
        url, _ = other(path.read_bytes())
        values, described = run_wasm(browser, url, body)
        stream = open_stream(path)
        assert [g["size"] for g in described["groups"]] == [g["size"] for g in stream.groups], path.name
        assert described["config"]["level"] == stream.config["level"]
        assert described["complete"] == stream.complete, path.name
        values = iter(values)
        for i, g in enumerate(stream.groups):
            t = g["frames"] // 2
            frame, shown = stream.group(i).frame(t), stream.group(i).visible(t)
            for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
                got = np.frombuffer(base64.b64decode(next(values)), np.float32).reshape(frame[name].shape)
                if name == "logit_opacities" and shown is not None:
                    assert (np.isneginf(got) == ~shown).all()
                    got = np.where(shown, got, frame[name])
                np.testing.assert_allclose(got, frame[name], rtol=1e-5, atol=1e-5, err_msg=f"{path.name} {name}")


def test_simd_draws_what_scalar_draws(browser, server):
    browser.goto(server.url + "?src=none.gsv")
    body = """
        native.decode(0, payload(groups[1]), config.level);
        native.frame(0, 1);
        const view = new Float32Array([200, 150, 240, 240, 100, 75, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0.01, 0.3]);
        const pictures = [];
        for (let level = 0; native.x.use_level(level); level++) {
            let splats;
            native.project(view, 1, (band) => (splats = band.splats.slice()));
            pictures.push(base64(native.draw([splats], 200, 150, [0.1, 0.2, 0.3])));
        }
        return pictures;
    """
    simd, scalar = (np.frombuffer(base64.b64decode(p), np.uint8) for p in run_wasm(browser, "/stream.gsv", body))
    assert scalar.std() > 10
    assert np.abs(simd.astype(int) - scalar).max() <= 1

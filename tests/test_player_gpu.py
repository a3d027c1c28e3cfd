"""The player's GPU path, drawn by Spark on a WebGL2 in software, beside the CPU renderer; and who draws when."""

import base64

import numpy as np
import pytest
from playing import GROUPS, LENGTH, PLAYER, camera_of, canvas, load, notes, part, psnr, show

from gscodec.decode import open_stream
from gscodec.render.image import render_image


def gpu_picture(browser, t: int):
    """Camera and [H, W, 3] u8 of frame `t`; read in the task that has drawn it, after which the buffer may be empty."""
    view, data = browser.eval(f"""{PLAYER}.show({t}).then(({{ view }}) => {{
        const copy = Object.assign(document.createElement("canvas"), {{ width: view[0], height: view[1] }});
        const context = copy.getContext("2d");
        context.drawImage({part("canvas + canvas")}, 0, 0);
        const d = context.getImageData(0, 0, copy.width, copy.height).data;
        let s = ""; for (let i = 0; i < d.length; i += 8192) s += String.fromCharCode(...d.subarray(i, i + 8192));
        return [Array.from(view), btoa(s)];
    }})""")
    camera = camera_of(view)
    return camera, np.frombuffer(base64.b64decode(data), np.uint8).reshape(camera.height, camera.width, 4)[..., :3]


@pytest.fixture(scope="module")
def on_gpu(gl_browser, server):
    load(gl_browser, server.url, size="320x200", autoplay="off", renderer="gpu")
    gl_browser.wait(f"{PLAYER}.engine.onGpu")
    return gl_browser


def test_the_picture_is_that_of_the_renderer(on_gpu, gsv):
    stream = open_stream(gsv)
    background = tuple(stream.config["background"])
    for t in (0, LENGTH + 5, 3 * LENGTH + 1):  # with lifetimes and without
        camera, got = gpu_picture(on_gpu, t)
        want = render_image(stream.frame(t), camera, background)
        assert want.std() > 10
        assert psnr(got, want) >= 35, t
    assert on_gpu.errors == []


def test_off_centre_axes_and_a_view_from_near(on_gpu, gsv):
    stream = open_stream(gsv)
    for change in (f"{PLAYER}.camera.use(1)", f"{PLAYER}.camera.zoom(2.5)"):
        on_gpu.eval(change)
        camera, got = gpu_picture(on_gpu, 2)
        want = render_image(stream.frame(2), camera, tuple(stream.config["background"]))
        assert psnr(got, want) >= 35, change
    on_gpu.eval(f"{PLAYER}.camera.reset()")


def test_it_plays_and_goes_back_to_the_cpu(on_gpu, gsv):
    on_gpu.eval(f"{PLAYER}.play()")
    on_gpu.wait(f"{PLAYER}.frame > {LENGTH + 1}")
    on_gpu.eval(f"{part('[data-do=stats]')}.click()")
    assert "SwiftShader" in on_gpu.wait(f"{part('.stats')}.textContent")
    menu = part("[data-set=renderer]")
    on_gpu.eval(f"{menu}.value = 'cpu'; {menu}.dispatchEvent(new Event('change', {{bubbles: true}}))")
    stream = open_stream(gsv)
    want = render_image(stream.frame(3), show(on_gpu, 3), tuple(stream.config["background"]))
    assert np.abs(canvas(on_gpu).astype(int) - want).max() <= 2
    assert on_gpu.eval(f"{part('canvas + canvas')} === null && !{part('canvas')}.hidden")
    on_gpu.eval(f"{menu}.value = 'gpu'; {menu}.dispatchEvent(new Event('change', {{bubbles: true}}))")
    on_gpu.wait(f"{PLAYER}.engine.onGpu")
    assert psnr(gpu_picture(on_gpu, 3)[1], want) >= 35


def test_a_lost_context_is_made_up_for(on_gpu):
    on_gpu.eval(f"{part('canvas + canvas')}.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()")
    on_gpu.wait(f"!{PLAYER}.engine.onGpu")
    assert "context was lost" in notes(on_gpu)
    show(on_gpu, GROUPS * LENGTH - 1)


def test_software_is_not_chosen(gl_browser, server):
    load(gl_browser, server.url, size="64x64")
    gl_browser.wait(f"{PLAYER}.frame > 3")
    assert not gl_browser.eval(f"{PLAYER}.engine.onGpu")
    loaded = gl_browser.eval("performance.getEntriesByType('resource').map((e) => e.name)")
    assert not any("spark.js" in name for name in loaded)


def test_no_webgl_is_said(browser, server):
    load(browser, server.url, size="64x64", renderer="gpu", autoplay="off")
    assert "GPU cannot be used" in browser.wait(f"{part('.notes')}.innerText")
    show(browser, 5)

"""The player's GPU path, drawn by Spark with WebGL2 in software, against the CPU renderer; choice of GPU or CPU."""

import time

import numpy as np
import pytest
from playing import GROUPS, LENGTH, PLAYER, camera_of, canvas, load, notes, part, pixels, psnr, show

from gscodec.decode import open_stream
from gscodec.render.image import render_image

GPU_CANVAS = part("canvas + canvas")


def gpu_picture(browser, t: int):
    """Camera and [H, W, 3] u8 of frame `t`."""
    got = pixels(browser, f"{PLAYER}.show({t}).then(() => {GPU_CANVAS})")
    return camera_of(browser.eval(f"Array.from({PLAYER}.shown.view)")), got


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
    assert on_gpu.eval(f"{GPU_CANVAS} === null && !{part('canvas')}.hidden")
    on_gpu.eval(f"{menu}.value = 'gpu'; {menu}.dispatchEvent(new Event('change', {{bubbles: true}}))")
    on_gpu.wait(f"{PLAYER}.engine.onGpu")
    assert psnr(gpu_picture(on_gpu, 3)[1], want) >= 35


# A headset whose head is at the origin and looks along -z: two eyes of 200 x 200 pixels, 6 cm apart, side by side on
# the canvas. `window.eyes` is a copy of the last drawn frame, `window.session` the session.
HEADSET = """
class Session extends EventTarget {
    renderState = {};
    enabledFeatures = [];
    inputSources = [];
    updateRenderState(state) { Object.assign(this.renderState, state); }
    async requestReferenceSpace() { return new EventTarget(); }
    requestAnimationFrame(draw) { return setTimeout(() => this.frame(draw), 16); }
    cancelAnimationFrame(id) { clearTimeout(id); }
    frame(draw) {
        const pose = (x) => ({ matrix: new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1]) });
        const projectionMatrix = new Float32Array([2, 0, 0, 0, 0, 2, 0, 0, 0, 0, -1, -1, 0, 0, -0.02, 0]);
        const views = ["left", "right"].map((eye, i) => ({ eye, projectionMatrix, transform: pose([-0.03, 0.03][i]) }));
        draw(performance.now(), { getViewerPose: () => ({ views, transform: pose(0) }) });
        window.eyes = Object.assign(document.createElement("canvas"), { width: 400, height: 200 });
        window.eyes.getContext("2d").drawImage(CANVAS, 0, 0);
    }
    async end() { this.dispatchEvent(new Event("end")); }
}
window.XRWebGLLayer = class {
    framebuffer = null;
    framebufferWidth = 400;
    framebufferHeight = 200;
    getViewport({ eye }) { return { x: eye === "left" ? 0 : 200, y: 0, width: 200, height: 200 }; }
};
window.XRWebGLBinding = class {};
WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
window.session = new Session();
navigator.xr.requestSession = async () => window.session;
"""


def comes_to(picture, want) -> bool:
    """Waits for the picture: splats are sorted and drawn asynchronously, in a session and after it."""
    for _ in range(100):
        if psnr(picture(), want) >= 35:
            return True
        time.sleep(0.1)
    return False


def test_a_headset_sees_the_scene_with_two_eyes(on_gpu, gsv):
    on_gpu.eval(f"{{ {HEADSET.replace('CANVAS', GPU_CANVAS)} }}")
    show(on_gpu, 2)
    level, radius = on_gpu.eval(f"[Array.from({PLAYER}.camera.level()), {PLAYER}.camera.radius]")
    on_gpu.eval(f"{part('[data-do=vr]')}.click()")
    on_gpu.wait(f"{PLAYER}.engine.gpu.head")
    on_gpu.wait("!!window.eyes")  # the first frame of the session is drawn
    stream = open_stream(gsv)
    want = []
    for x in (-0.03, 0.03):
        eye = [200, 200, 200, 200, 100, 100, *level[6:]]
        eye[9] -= x * radius  # a scene becomes 2 m high
        want.append(render_image(stream.frame(2), camera_of(eye), tuple(stream.config["background"])))
    assert psnr(want[0], want[1]) < 30
    assert comes_to(lambda: pixels(on_gpu, "window.eyes"), np.concatenate(want, 1))
    on_gpu.eval(f"{PLAYER}.play()")
    on_gpu.wait(f"{PLAYER}.frame > {LENGTH}")
    on_gpu.eval("window.session.end()")
    assert on_gpu.eval(f"{PLAYER}.engine.gpu.head") is None
    camera, _ = gpu_picture(on_gpu, 3)
    shown = render_image(stream.frame(3), camera, tuple(stream.config["background"]))
    assert comes_to(lambda: gpu_picture(on_gpu, 3)[1], shown)


def test_augmented_reality_stands_on_the_floor_and_goes_where_one_taps(on_gpu, gsv):
    on_gpu.eval(f"{{ {HEADSET.replace('CANVAS', GPU_CANVAS)} window.session.environmentBlendMode = 'alpha-blend'; }}")
    on_gpu.eval("""{
        navigator.xr.requestSession = async (...asked) => ((window.asked = asked), window.session);
        window.session.requestReferenceSpace = async (type) => Object.assign(new EventTarget(), { type });
    }""")
    show(on_gpu, 2)
    script = "[Array.from(c.level()), c.radius, Array.from(c.foot)]"
    level, radius, foot = on_gpu.eval(f"((c) => {script})({PLAYER}.camera)")
    bounds = on_gpu.eval(f"{PLAYER}.engine.bounds")
    assert foot == [(bounds[0] + bounds[3]) / 2, bounds[1], (bounds[2] + bounds[5]) / 2]  # y is up
    on_gpu.eval(f"{part('[data-do=ar]')}.click()")
    on_gpu.wait("!!window.eyes")
    assert on_gpu.eval("window.asked") == ["immersive-ar", {"requiredFeatures": ["local-floor"]}]
    stream, flip = open_stream(gsv), np.diag([1.0, -1, -1])
    turn = np.reshape(level[6:18], (3, 4))[:, :3]

    def standing(x, z):
        """Picture of both eyes at the origin of the floor; the room behind is black in a copy of the canvas."""
        want = []
        for eye in (-0.03, 0.03):
            moved = flip @ np.array([x - eye, 0, z]) * radius - turn @ np.array(foot)  # a scene becomes 2 m high
            view = [200, 200, 200, 200, 100, 100, *np.c_[turn, moved].ravel(), 0.01, 0.3]
            want.append(render_image(stream.frame(2), camera_of(view), (0, 0, 0)))
        return np.concatenate(want, 1)

    assert standing(0, -2).std() > 10
    assert comes_to(lambda: pixels(on_gpu, "window.eyes"), standing(0, -2))
    # a tap: a ray from 1.5 m above the floor, down and ahead to the right, which meets it at (0.5, -3)
    on_gpu.eval("""{
        const matrix = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, -0.5, 1.5, 3, 0, 0, 1.5, 0, 1]);
        const frame = { getPose: () => ({ transform: { matrix } }) };
        window.session.dispatchEvent(Object.assign(new Event("select"), { frame, inputSource: {} }));
    }""")
    assert comes_to(lambda: pixels(on_gpu, "window.eyes"), standing(0.5, -3))
    on_gpu.eval("window.session.end()")
    camera, _ = gpu_picture(on_gpu, 3)
    shown = render_image(stream.frame(3), camera, tuple(stream.config["background"]))
    assert comes_to(lambda: gpu_picture(on_gpu, 3)[1], shown)


def test_a_lost_context_is_made_up_for(on_gpu):
    on_gpu.eval(f"{GPU_CANVAS}.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()")
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

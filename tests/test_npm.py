"""The npm package: packed, installed and imported; frames and pictures against those of decoder and renderer."""

import base64
import dataclasses
import functools
import http.server
import json
import os
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest
from playing import FPS, GROUPS, LENGTH, Static, camera_of, cameras, pixels, psnr, sequence, serving
from synthetic import encode_sequence

from gscodec.decode import open_scene, open_stream
from gscodec.decode.scene import Track
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.encode.tracks import TrackPlan, write_tracks
from gscodec.model.placement import Placement
from gscodec.render.image import render_image

ROOT = Path(__file__).parent.parent
PAGE = """<!doctype html><link rel="icon" href="data:,"><canvas></canvas><script type="importmap">{"imports": {
    "gscodec": "/node_modules/gscodec/embed/stream.js",
    "gscodec/three": "/node_modules/gscodec/embed/three.js",
    "three": "/node_modules/gscodec/spark.js",
    "@sparkjsdev/spark": "/node_modules/gscodec/spark.js",
    "gscodec/playcanvas": "/node_modules/gscodec/embed/playcanvas.js",
    "playcanvas": "/playcanvas.mjs"
}}</script>"""
INSTALLED = ("build/tools", "player/examples")  # folders of PlayCanvas: `make tools`, or npm install for the examples


@pytest.fixture(scope="module")
def app(tmp_path_factory, gsv):
    """A folder with the package installed from its tarball, a stream and an empty page."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not here (Debian: apt-get install npm)")
    path = tmp_path_factory.mktemp("app")
    shutil.copytree(ROOT / "player", path / "source/player", ignore=shutil.ignore_patterns("node_modules"))
    shutil.copy(ROOT / "LICENSE", path / "source")
    run = functools.partial(
        subprocess.run, check=True, capture_output=True, env=os.environ | {"npm_config_offline": "true"}
    )
    run(["npm", "pack", path / "source/player"], cwd=path)
    (path / "package.json").write_text('{"name": "app", "private": true}')
    run(["npm", "install", "--no-audit", "--no-fund", *path.glob("*.tgz")], cwd=path)
    shutil.copy(gsv, path / "a.gsv")
    stream = open_scene(gsv).tracks[0].stream
    placements = (Placement("late", offset=3), Placement("far", keys=((0, (1, 0, 0, 0), (3, 0, 0), 1.0),)))
    write_tracks(path / "two.gsv", [TrackPlan.of(Track(stream, p)) for p in placements])
    (path / "index.html").write_text(PAGE)
    return path


@pytest.fixture(scope="module")
def address(app):
    s = serving(http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Static, directory=app)))
    yield f"http://127.0.0.1:{s.server_address[1]}/"
    s.shutdown()
    s.server_close()


def test_what_is_packed(app):
    with tarfile.open(next(app.glob("*.tgz"))) as tar:
        names = {n.removeprefix("package/") for n in tar.getnames()}
    package = json.loads((ROOT / "player/package.json").read_text())
    assert f'\nversion = "{package["version"]}"\n' in (ROOT / "pyproject.toml").read_text()
    for entry in package["exports"].values():
        assert {path.removeprefix("./") for path in entry.values()} <= names
    assert {"LICENSE", "README.md", "worker.js", "spark.js", "native.wasm.gz"} <= names
    assert not [n for n in names if Path(n).suffix in (".py", ".html", ".sha256", ".tgz") or "examples" in n]


def test_types_name_what_there_is(browser, address):
    """Each member in a declaration is a member of the class."""
    browser.goto(address)
    for module, name in (("embed/stream", "GsvStream"), ("embed/stream", "Camera"), ("embed/playback", "Playback")):
        text = (ROOT / f"player/{module}.d.ts").read_text()
        body = re.search(rf"export class {name} {{(.*?)\n}}", text, re.DOTALL)[1]
        members = re.findall(r"^  (static )?(?:readonly )?(\w+)[(:?]", body, re.MULTILINE)
        assert len(members) > 5
        script = f"""import("/node_modules/gscodec/{module}.js").then(({{ {name} }}) => {{
            const made = {"new " + name + '({ src: "none.gsv" })' if name == "Playback" else name + ".prototype"};
            const missing = ([alone, key]) => !(key in (alone ? {name} : made));
            return {json.dumps(members)}.filter(missing).map(([, key]) => key);
        }})"""
        missing = set(browser.eval(script)) - {"loop"}  # a field that GsvStream has once it is open
        assert not missing, name


def test_node_imports_it_and_is_told_that_it_needs_a_browser(app):
    code = 'import { GsvStream } from "gscodec"; await GsvStream.open("a.gsv").catch((e) => console.log(e.message));'
    done = subprocess.run(["node", "--input-type=module", "-e", code], cwd=app, capture_output=True, text=True)
    assert "needs web workers" in done.stdout, done.stderr


OPEN = "import('gscodec').then(async ({ GsvStream }) => {"


def test_frames_of_an_address_and_of_a_blob(browser, address, gsv):
    browser.goto(address)
    script = f"""{OPEN}
        const base64 = ({{ buffer }}) => {{
            let s = ""; for (const byte of new Uint8Array(buffer)) s += String.fromCharCode(byte);
            return btoa(s);
        }};
        const blob = await (await fetch("a.gsv")).blob();
        const out = [];
        for (const source of ["a.gsv", blob]) {{
            const stream = await GsvStream.open(source);
            const times = [{3 * LENGTH + 4}, 0, 1, {LENGTH}, {GROUPS * LENGTH - 1}];
            for (const [i, f] of (await Promise.all(times.map((t) => stream.frame(t)))).entries()) {{
                const arrays = [f.means, f.quats, f.logScales, f.logitOpacities, f.sh0, f.shN];
                out.push([times[i], f.count, arrays.map(base64)]);
            }}
            const wrong = await stream.frame(stream.frameCount).catch((e) => e.message);
            stream.close();
            out.push([wrong, await stream.frame(0).catch((e) => e.message)]);
        }}
        return out;
    }})"""
    stream, names = open_stream(gsv), ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    answers = browser.eval(script)
    assert len(answers) == 12
    for answer in answers:
        if len(answer) == 2:
            assert answer == [f"There is no frame 30: expected 0 to {GROUPS * LENGTH - 1}.", "The stream is closed."]
            continue
        t, count, arrays = answer
        want, arrays = stream.frame(t), [np.frombuffer(base64.b64decode(a), np.float32) for a in arrays]
        shown = np.isfinite(arrays[3])  # the decoder leaves out Gaussians outside their lifetime
        assert len(shown) == count
        for name, got in zip(names, arrays, strict=True):
            got = got.reshape(count, *getattr(want, name).shape[1:])[shown]
            np.testing.assert_allclose(got, getattr(want, name), rtol=1e-5, atol=1e-5, err_msg=f"{name} of {t}")


@pytest.mark.parametrize("name", ["a.gsv", "two.gsv"])
def test_it_draws_on_a_canvas(browser, address, gsv, name):
    """Of a file of several tracks the first one, as `frame` has it: not placed, from its own first frame."""
    browser.goto(address)
    script = f"""{OPEN}
        const canvas = document.querySelector("canvas");
        const stream = await GsvStream.open("{name}", {{ canvas, layers: "auto" }});
        const camera = stream.camera();
        camera.orbit(0.2, 0.1);
        window.view = Array.from(camera.view(200, 150));
        await stream.draw(8, camera.view(200, 150));
        stream.close();
        return canvas;
    }})"""
    got = pixels(browser, script)
    stream = open_stream(gsv)
    want = render_image(stream.frame(8), camera_of(browser.eval("view")), tuple(stream.config["background"]))
    assert want.std() > 10
    assert psnr(got, want) >= 35


def test_errors_are_told(browser, address):
    browser.goto(address)
    wrong = "[new Blob(['this is not a stream']), 'none.gsv']"
    told = browser.eval(
        f"{OPEN} return Promise.all({wrong}.map((s) => GsvStream.open(s).then(() => null, (e) => e.message))); }})"
    )
    assert len(told[0]) > 10
    assert told[1] == "The file was not found on the server."


def test_a_drawing_that_fails_is_told_and_the_stream_goes_on(browser, address):
    browser.goto(address)
    script = f"""{OPEN}
        const canvas = document.querySelector("canvas");
        const told = [];
        for (const options of [{{}}, {{ canvas }}]) {{
            const stream = await GsvStream.open("a.gsv", options);
            told.push(await stream.draw(1, stream.camera().view(0, 0)).catch((e) => e.message));
            told.push((await stream.frame(1)).count);
            stream.close();
        }}
        return told;
    }})"""
    no_canvas, count, empty, again = browser.eval(script)
    assert "no canvas" in no_canvas
    assert "0 x 0 pixels is empty" in empty
    assert count == again > 0


LOW_PASS = 2.0  # of the cameras of a stream, unlike the default
SCENE = """Promise.all([import("three"), import("gscodec/three")]).then(async ([three, { GsvObject }]) => {
    three.ColorManagement.enabled = false;
    const canvas = document.querySelector("canvas");
    const renderer = new three.WebGLRenderer({ canvas, antialias: false });
    renderer.setSize(200, 150, false);
    renderer.setClearColor(new three.Color(0.2, 0.3, 0.5), 1);
    const [scene, camera] = [new three.Scene(), new three.PerspectiveCamera(45, 200 / 150, 0.01, 100)];
    const object = await new GsvObject({ src: "z.gsv", autoplay: false, upright: UPRIGHT }).ready;
    const exact = { preBlurAmount: object.lowPass, blurAmount: 0, minAlpha: 1 / 255, maxStdDev: 3.33 };
    scene.add(new three.SparkRenderer({ renderer, ...exact }), object);
    camera.position.set(0.5, 1, 3);
    camera.lookAt(0, 0, 0);
    camera.updateMatrixWorld(true);
    object.playback.position = 8;
    window.scene = { object, draw: () => (renderer.render(scene, camera), canvas), shown: null };
    object.addEventListener("frame", (e) => (window.scene.shown = e.frame));
    return camera.matrixWorldInverse.toArray();
})"""


def scene_comes_to(browser, want) -> bool:
    """Waits for the picture: splats are sorted asynchronously."""
    for _ in range(200):
        got = pixels(browser, "new Promise((done) => setTimeout(() => done(window.scene.draw()), 30))")
        if browser.eval("window.scene.shown") == 8 and psnr(got, want) >= 33:
            return True
    return False


def test_a_three_js_scene_shows_it(gl_browser, address, app):
    trained = [dataclasses.replace(camera, low_pass=LOW_PASS) for camera in cameras()]
    config = stream_config(
        fps=FPS, sh_degree=1, gaussians=400, frames=LENGTH, up="z", background=(0.2, 0.3, 0.5), cameras=trained
    )
    encode_sequence(sequence(sh_count=3), app / "z.gsv", config, EncodeSettings(quality=80))
    stream = open_stream(app / "z.gsv")
    for upright in ("false", "true"):  # the axes of the stream, or y up
        gl_browser.goto(address)
        view = np.array(gl_browser.eval(SCENE.replace("UPRIGHT", upright))).reshape(4, 4).T
        if upright == "true":
            view = view @ np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        view = np.diag([1.0, -1, -1, 1]) @ view  # OpenGL -> OpenCV
        focal = 75 / np.tan(np.radians(22.5))
        camera = camera_of([200, 150, focal, focal, 100, 75, *view[:3].ravel(), 0.01, LOW_PASS])
        want = render_image(stream.frame(8), camera, tuple(stream.config["background"]))
        assert want.std() > 10
        assert scene_comes_to(gl_browser, want), upright
        gl_browser.eval("window.scene.object.dispose()")
    assert gl_browser.errors == []


PLAYCANVAS = """Promise.all([import("playcanvas"), import("gscodec/playcanvas")]).then(async ([pc, { GsvScript }]) => {
    const canvas = document.querySelector("canvas");
    const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false } });
    app.setCanvasFillMode(pc.FILLMODE_NONE, 200, 150);
    app.setCanvasResolution(pc.RESOLUTION_FIXED, 200, 150);
    app.start();
    const entity = (name, type, data) => {
        const e = new pc.Entity(name);
        e.addComponent(type, data);
        app.root.addChild(e);
        return e;
    };
    const clearColor = new pc.Color(0.2, 0.3, 0.5);
    const camera = entity("camera", "camera", { clearColor, fov: 45, nearClip: 0.01, farClip: 100 });
    camera.setPosition(0.5, 1, 3);
    camera.lookAt(0, 0, 0);
    const movie = entity("movie", "script", {});
    const script = movie.script.create(GsvScript, { properties: { src: "z.gsv", autoplay: false } });
    window.scene = { shown: null, draw: () => new Promise((done) => app.once("frameend", () => done(canvas))) };
    movie.script.gsv.on("frame", (frame) => (window.scene.shown = frame));
    await script.ready;
    script.playback.position = 8;
    return Array.from(camera.camera.viewMatrix.data);
})"""


def test_a_playcanvas_scene_shows_it(gl_browser, address, app):
    engine = [ROOT / d / "node_modules/playcanvas/build/playcanvas.mjs" for d in INSTALLED]
    engine = [e for e in engine if e.exists()]
    if not engine:
        pytest.skip("PlayCanvas is not installed: npm install in player/examples")
    shutil.copy(engine[0], app / "playcanvas.mjs")
    config = stream_config(fps=FPS, sh_degree=1, gaussians=400, frames=LENGTH, background=(0.2, 0.3, 0.5))
    encode_sequence(sequence(sh_count=3), app / "z.gsv", config, EncodeSettings(quality=80))
    stream = open_stream(app / "z.gsv")
    gl_browser.goto(address)
    view = np.array(gl_browser.eval(PLAYCANVAS)).reshape(4, 4).T
    view = np.diag([1.0, -1, -1, 1]) @ view
    focal = 75 / np.tan(np.radians(22.5))
    camera = camera_of([200, 150, focal, focal, 100, 75, *view[:3].ravel(), 0.01, 0.3])
    want = render_image(stream.frame(8), camera, tuple(stream.config["background"]))
    assert want.std() > 10
    assert scene_comes_to(gl_browser, want)
    assert gl_browser.errors == []

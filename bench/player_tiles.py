"""Bytes fetched and decoding time in headless Chromium for a view of a tenth of a million Gaussians.

usage: GSCODEC_DATA=... python -m bench.player_tiles FOLDER        writes bench/results/player_tiles.json

The scene is that of bench.tiles: 13 copies of the statue in one group, and a camera that sees about a tenth of them.
One page opens it as usual, with only the tiles in view; another page takes all tiles. Bytes are those received before
the first picture, the first 64 kB of the file included. A decoding time is from the request until every worker has its
tiles ready to be drawn, from bytes in the page; median of several runs, both pages in turn. Then the camera moves over
a third of the scene in four seconds: `move` has the bytes received by then and the longest time between two pictures;
`move_of_whole` has those of the page with all tiles.
"""

from __future__ import annotations

import argparse
import json
import statistics
import threading
from pathlib import Path

import numpy as np

from gscodec import _native
from gscodec.decode import open_stream
from gscodec.encode.encode import stream_config
from gscodec.encode.writer import StreamWriter
from gscodec.metrics.image import psnr
from gscodec.model.camera import Camera
from gscodec.player.server import Server

from .browser import Browser, Browsers
from .machine import RESULTS, update_entries
from .player import PLAYER
from .tiles import LEVEL, copies, lens_of_view, statue

RUNS, SIZE, STEPS = 7, 512, 40
RESULT = RESULTS / "player_tiles.json"

# opens the stream; partly: whether only the tiles in view are fetched
OPEN = """async ([partly, stream]) => {
    const player = document.querySelector("gsv-player");
    if (!partly) player.engine.constructor.partly = Infinity;
    player.setAttribute("src", stream);
    await new Promise((done) => player.addEventListener("picture", done, { once: true }));
    const { source } = player.engine;
    return { bytes: source.received, gaussians: player.engine.gaussians(0), ranged: source.ranged };
}"""

# decodes group 0 again from the bytes in the page; ms
DECODE = """async () => {
    const { engine } = document.querySelector("gsv-player");
    while (engine.groups.get(0)?.state !== "ready") await new Promise((done) => setTimeout(done, 20));
    const decoded = new Promise((done) => engine.addEventListener("decoded", done, { once: true }));
    engine.forget();
    const start = performance.now();
    engine.want(0, false);
    await decoded;
    return performance.now() - start;
}"""

# moves the scene by `way` along x in steps; the longest time between two pictures in ms, and the bytes
MOVE = """async ([steps, from, way]) => {
    const player = document.querySelector("gsv-player");
    const times = [performance.now()];
    player.addEventListener("picture", () => times.push(performance.now()));
    const { reference } = player.camera;
    for (let i = 1; i <= steps; i++) {
        const viewmat = [...reference.viewmat];
        viewmat[3] = from + (way * i) / steps;
        player.camera.reference = { ...reference, viewmat };
        await new Promise((done) => setTimeout(done, 100));
    }
    const gaps = times.slice(1).map((t, i) => t - times[i]);
    return { longest_gap_ms: Math.max(...gaps), pictures: gaps.length, bytes: player.engine.source.received };
}"""


def million(folder: Path) -> tuple[Path, float]:
    """The file of the scene (made if it is missing), whose camera sees a tenth of it, and the width of the scene."""
    path, width = folder / "million.gsv", folder / "million.width"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        q = copies(_native.DecodedGroup(statue(), LEVEL).quantized())
        payload = _native.encode_group(q)[0]
        group = _native.DecodedGroup(payload, LEVEL)
        tenth = camera(*lens_of_view(group, 0.1))
        width.write_text(str(np.ptp(group.frame(0)["means"][:, 0])))
        config = stream_config(fps=25, sh_degree=0, gaussians=len(q), frames=1, cameras=[tenth])
        writer = StreamWriter(path, config, {})
        writer.append(payload, 1)
        writer.finish()
    return path, float(width.read_text())


def camera(eye: np.ndarray, slope: float) -> Camera:
    """A camera at `eye` that looks along -y, with the tangent `slope` of half its angle."""
    f = SIZE / 2 / slope
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # rows: right x, down z, forward -y
    viewmat = np.eye(4)
    viewmat[:3] = np.column_stack([down, -down @ eye])
    return Camera("tenth", np.array([[f, 0, SIZE / 2], [0, f, SIZE / 2], [0, 0, 1]]), viewmat, SIZE, SIZE)


def open_page(browsers: Browsers, url: str, partly: bool) -> tuple[Browser, dict]:
    """A page that shows the view, and its received bytes and Gaussians."""
    browser = browsers.start("--disable-gpu")
    browser.goto(f"{url}?size={SIZE}x{SIZE}&autoplay=off&camera=tenth&src=none.gsv")
    return browser, browser.page.evaluate(OPEN, [partly, url + "stream.gsv"])


def picture(browser: Browser) -> np.ndarray:
    """[H, W, 3] u8: the picture in the page."""
    script = f"""{PLAYER}.show(0).then(() => {{
        const canvas = {PLAYER}.shadowRoot.querySelector("canvas");
        return Array.from(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data);
    }})"""
    return np.array(browser.eval(script), np.uint8).reshape(SIZE, SIZE, 4)[..., :3]


def measure(browsers: Browsers, folder: Path) -> dict:
    """The figures of the scene."""
    path, width = million(folder)
    server = Server(path)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    (part, seen), (whole, all_) = (open_page(browsers, server.url, partly) for partly in (True, False))
    pictures = picture(part), picture(whole)
    runs = [[browser.eval(f"({DECODE})()") for browser in (part, whole)] for _ in range(RUNS)]
    times = [statistics.median(own) for own in zip(*runs, strict=True)]
    start = open_stream(path).cameras[0].viewmat[0, 3]
    moves = [browser.page.evaluate(MOVE, [STEPS, float(start), width / 3]) for browser in (part, whole)]
    server.shutdown()
    size = path.stat().st_size
    return {
        "scene": path.stem,
        "gaussians": all_["gaussians"],
        "gaussians_decoded": seen["gaussians"],
        "bytes": all_["bytes"],
        "bytes_fetched": seen["bytes"],
        "byte_share": round(seen["bytes"] / size, 4),
        "ms": round(times[1], 1),
        "ms_part": round(times[0], 1),
        "time_share": round(times[0] / times[1], 4),
        "psnr_of_pictures": round(min(psnr(*pictures), 99.0), 1),
        "move": {k: round(v) for k, v in moves[0].items()},
        "move_of_whole": {k: round(v) for k, v in moves[1].items()},
    }


def main() -> None:
    """Measures the scene."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the stream is made and kept")
    a = parser.parse_args()
    with Browsers() as browsers:
        for entry in update_entries(RESULT, (measure(browsers, f) for f in [a.folder]), key=lambda e: e["scene"]):
            print(json.dumps(entry), flush=True)


if __name__ == "__main__":
    main()

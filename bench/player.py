"""Speed and memory of the web player's CPU path, in headless Chromium without a GPU.

usage: python -m bench.player FOLDER [statue] [demo] ...

Streams lie in FOLDER; a missing one is encoded first, which is not measured:
  demo         the bundled capture
  demo_slow    the same with the preset slow
  lumberjack   the lumberjack of the data folder at 512 x 512, with the default preset
  statue       the moving statue of the data folder (GSCODEC_DATA), 40 frames, without Gaussians that no view shows
  statue_all   the same with all of its 101,275 Gaussians
  long         the same as statue with 300 frames, for the memory

bench/results/player.json has an entry for each stream:
  first_picture_ms       from the start of the navigation; page and stream come from this machine, nothing is cached
  first_picture_slow_ms  the same over 2 Mbit/s with 40 ms to the first byte of each answer, throttled by Chromium
  first_picture_bytes    bytes received by then over that link
  fps_clock              frames per second if 60, the display's limit, are requested; median of 3 x 2 s
  fps_free               frames per second if all frames are requested in order, without the display's clock
  project_ms, blend_ms   medians per frame: evaluation and projection; the slower one of the raster workers
  decode, evaluate       ms per frame to decode a group and to evaluate its frames, wasm and native, one core each
  memory_mb              largest proportional set size of the page's process while the stream plays once
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import threading
import time
from pathlib import Path

from gscodec.player.server import Server

from .browser import Browser, Browsers
from .machine import RESULTS, ROOT, update_entries
from .run import animated, gscodec

SIZE = "512x512"
LOADS = 5
# ms, and bytes a second
SLOW = {"offline": False, "latency": 40, "downloadThroughput": 2e6 / 8, "uploadThroughput": 2e6 / 8}
PLAYER = "document.querySelector('gsv-player')"
DEMOS = {"demo": (), "demo_slow": ("--preset", "slow")}
CAPTURES = ("lumberjack",)
STATUES = {"statue": (40, ()), "statue_all": (40, ("--keep-all",)), "long": (300, ())}

# keeps the time of the first picture in the page
KEEP = "addEventListener('picture', () => (window.firstPicture ??= performance.now()), true)"
FIRST = "window.firstPicture"
RECEIVED = f"""performance.getEntries().filter((e) => e.startTime < {FIRST})
    .reduce((sum, e) => sum + (e.transferSize ?? 0), 0)"""

# draws `count` frames in order; times of each in ms
FREE = """async ([count]) => {
    const player = document.querySelector("gsv-player");
    player.pause();
    await player.show(0);
    const { engine } = player;
    const view = player.camera.view(512, 512);
    const times = { project: [], blend: [] };
    let [t, drawn] = [0, 0];
    const next = () => new Promise((done) => engine.addEventListener("picture", done, { once: true }));
    const ask = () => {
        engine.want(engine.groupOf(t), true);
        while (engine.renderer.free && engine.ready(engine.groupOf(t))) {
            engine.draw(t, view);
            t = (t + 1) % player.frameCount;
        }
    };
    const start = performance.now();
    while (drawn < count) {
        ask();
        await Promise.race([next().then(() => {
            drawn++;
            for (const k of ["project", "blend"]) times[k].push(engine.stats[k]);
        }), new Promise((done) => setTimeout(done, 100))]);
    }
    return { seconds: (performance.now() - start) / 1000, ...times };
}"""

# decodes groups and evaluates their frames in one wasm module; ms per frame of three runs
DECODE = """async ([limit]) => {
    const { Native, load } = await import("/native.js");
    const native = await Native.create(await load(new URL("/native.wasm.gz", location.href)));
    const file = new Uint8Array(await (await fetch("/stream.gsv")).arrayBuffer());
    native.push(file);
    const { config, groups } = native.describe();
    const runs = [];
    for (let run = 0; run < 3; run++) {
        let [decode, evaluate, frames] = [0, 0, 0];
        for (const [i, g] of groups.slice(0, limit).entries()) {
            const payload = file.slice(g.offset, g.offset + g.size);
            const start = performance.now();
            const back = native.reference(payload);
            native.decode(i, payload, config.level, back ? { reference: i - back } : {});
            const decoded = performance.now();
            for (let t = 0; t < g.frames; t++) native.frame(i, t);
            decode += decoded - start;
            evaluate += performance.now() - decoded;
            frames += g.frames;
        }
        runs.push([decode / frames, evaluate / frames]);
    }
    return runs;
}"""

NATIVE = """
import sys, time, json
from gscodec.decode import open_stream
runs = []
for _ in range(3):
    stream = open_stream(sys.argv[1])
    decode = evaluate = frames = 0
    for i, g in enumerate(stream.groups[: int(sys.argv[2])]):
        start = time.perf_counter()
        group = stream.group(i)
        decoded = time.perf_counter()
        for t in range(g["frames"]):
            group.frame(t)
        decode += decoded - start
        evaluate += time.perf_counter() - decoded
        frames += g["frames"]
    runs.append([1e3 * decode / frames, 1e3 * evaluate / frames])
print(json.dumps(runs))
"""


def streams(folder: Path, names: list[str]) -> dict[str, Path]:
    """Name -> file of the streams `names`; a missing one is encoded, or left out where its data is missing."""
    data = Path(os.environ["GSCODEC_DATA"]) if "GSCODEC_DATA" in os.environ else None
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name in names:
        path = folder / f"{name}.gsv"
        if not path.exists() and name in DEMOS:
            gscodec("encode", ROOT / "examples" / "lumberjack", path, *DEMOS[name])
        elif not path.exists() and data and name in CAPTURES:
            gscodec("encode", data / name, path)
        elif not path.exists() and data:
            frames, options = STATUES[name]
            gscodec("encode", animated(data, folder, frames), path, *options)
        if path.exists():
            found[name] = path
        else:
            print(f"{name}: left out, GSCODEC_DATA is not set", file=sys.stderr)
    return found


def first_pictures(browsers: Browsers, url: str, link: dict | None = None) -> tuple[float, int]:
    """Milliseconds to the first picture, median of new browsers with an empty cache; bytes received by then.

    `link`: how Chromium throttles it (Network.emulateNetworkConditions of its DevTools protocol).
    """
    times = []
    for _ in range(LOADS):
        browser = browsers.start("--disable-gpu")
        browser.page.add_init_script(KEEP)
        if link:
            browser.call("Network.enable")
            browser.call("Network.emulateNetworkConditions", **link)
        browser.goto(f"{url}?size={SIZE}")
        times.append(browser.wait(FIRST))
        received = browser.eval(RECEIVED)
        browser.page.context.browser.close()
    return statistics.median(times), received


def clocked(browser: Browser, url: str, seconds: int = 2) -> float:
    """Frames per second if 60 are requested."""
    browser.page.add_init_script(KEEP)
    browser.goto(f"{url}?size={SIZE}")
    browser.wait(FIRST)
    browser.eval(f"{PLAYER}.speed = 60 / {PLAYER}.fps")
    time.sleep(2)
    count = f"new Promise((done) => {{ let n = 0; {PLAYER}.addEventListener('picture', () => n++);"
    count += f"setTimeout(() => done(n), {1000 * seconds}); }})"
    return statistics.median(browser.eval(count) / seconds for _ in range(3))


def renderer_memory(stop: threading.Event, found: list[float]) -> None:
    """Adds the proportional set size of each renderer process in MB to `found`, until `stop`."""
    while not stop.wait(0.1):
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                if b"--type=renderer" not in (entry / "cmdline").read_bytes():
                    continue
                line = next(x for x in (entry / "smaps_rollup").read_text().splitlines() if x.startswith("Pss:"))
                found.append(int(line.split()[1]) / 1024)
            except (OSError, StopIteration):
                continue


def memory(browser: Browser, url: str) -> float:
    """Largest MB of the page's process while the stream plays once at twice its speed."""
    stop, found = threading.Event(), []
    thread = threading.Thread(target=renderer_memory, args=(stop, found))
    thread.start()
    browser.goto(f"{url}?size={SIZE}&speed=2&loop=off")
    browser.wait(f"{PLAYER}.paused && {PLAYER}.frame === {PLAYER}.frameCount - 1")
    stop.set()
    thread.join()
    return max(found)


def decode_times(browser: Browser, url: str, path: Path, groups: int = 2) -> dict:
    """ms per frame in wasm and native and their ratio, medians of three runs."""
    browser.goto(url + "?src=none.gsv")
    wasm = browser.page.evaluate(DECODE, [groups])
    env = dict(os.environ, RAYON_NUM_THREADS="1")
    command = [sys.executable, "-c", NATIVE, str(path), str(groups)]
    native = json.loads(subprocess.run(command, env=env, check=True, capture_output=True, text=True).stdout)
    result = {}
    for i, what in enumerate(("decode", "evaluate")):
        page, here = (statistics.median(run[i] for run in runs) for runs in (wasm, native))
        result[what] = {"wasm_ms": round(page, 2), "native_ms": round(here, 2), "ratio": round(page / here, 2)}
    return result


def measure(browsers: Browsers, name: str, path: Path) -> dict:
    """The figures of one stream."""
    info = json.loads(gscodec("info", path, "--json")[0])
    server = Server(path)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    result = {"frames": info["frames"], "gaussians": info["gaussians"], "bytes": path.stat().st_size}
    if name == "long":
        return result | {"memory_mb": round(memory(browsers.start("--disable-gpu"), server.url))}
    slow, received = first_pictures(browsers, server.url, SLOW)
    browser = browsers.start("--disable-gpu")
    result |= {
        "first_picture_ms": round(first_pictures(browsers, server.url)[0]),
        "first_picture_slow_ms": round(slow),
        "first_picture_bytes": received,
        "fps_clock": round(clocked(browser, server.url), 1),
    }
    free = browser.page.evaluate(FREE, [100])
    result["fps_free"] = round(len(free["blend"]) / free["seconds"], 1)
    for key in ("project", "blend"):
        result[f"{key}_ms"] = round(statistics.median(free[key]), 2)
    result |= decode_times(browser, server.url, path)
    server.shutdown()
    return result


def main() -> None:
    """Measures the streams named on the command line, all by default."""
    all_ = [*DEMOS, *CAPTURES, *STATUES]
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the streams are made and kept")
    parser.add_argument("streams", nargs="*", metavar="STREAM", help=f"of {', '.join(all_)}; all by default")
    a = parser.parse_args()
    if unknown := set(a.streams) - set(all_):
        sys.exit(f"error: no such stream: {', '.join(unknown)}, expected {', '.join(all_)}")
    found = streams(a.folder, a.streams or all_)
    with Browsers() as browsers:
        browser = {"browser": f"Chromium {browsers.start().page.context.browser.version}", "size": SIZE}
        entries = ({"stream": name, **browser, **measure(browsers, name, path)} for name, path in found.items())
        for entry in update_entries(RESULTS / "player.json", entries, lambda e: e["stream"]):
            print(json.dumps(entry), flush=True)


if __name__ == "__main__":
    main()

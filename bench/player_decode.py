"""Decoding in the page by one worker and by all cores' workers, in headless Chromium.

usage: python -m bench.player_decode FOLDER [statue_all] [demo] ...       writes bench/results/player_decode.json

Streams are those of bench.player; missing ones are made. The page decodes the first group repeatedly, by one worker and
shared by all in turn, from bytes that it has. A decoding time is from the request until every worker has its tiles
ready to be drawn: it includes duplicate work, messages, and the wait for the slowest worker. Then frames are drawn: a
projection time is that of the slowest worker. Times are medians, which other work on the machine changes; the ratios
are of one run. For the ratio of shares, one instance decodes the whole group and then the share of each of two workers:
the possible gain of two idle cores, without messages.
"""

from __future__ import annotations

import argparse
import json
import statistics
import threading
from collections.abc import Iterator
from pathlib import Path

from gscodec.decode import open_stream
from gscodec.player.server import Server

from .browser import Browsers
from .machine import RESULTS, update_entries
from .player import DEMOS, PLAYER, SIZE, STATUES, streams

RUNS, DRAWN = 15, 20
RESULT = RESULTS / "player_decode.json"

# decodes group 0 with 1 worker and with `all`, in turn, and draws frames. {decode, project: {workers: [ms]}}
TIMES = """async ([runs, drawn]) => {
    const player = document.querySelector("gsv-player");
    player.pause();
    await player.show(0);
    const { engine } = player;
    const view = player.camera.view(512, 512);
    player.engine = null; // its clock asks for nothing any more
    const event = (type) => new Promise((done) => engine.addEventListener(type, (e) => done(e.detail), { once: true }));
    while ([...engine.groups.values()].some((g) => g.state !== "ready")) await event("decoded");
    const all = engine.shares;
    const times = { decode: {}, project: {}, pieces: {} };
    for (let run = 0; run < runs; run++) {
        for (const shares of [1, all]) {
            engine.shares = shares;
            engine.forget();
            const start = performance.now();
            const ready = event("decoded");
            engine.want(0, false);
            await ready;
            (times.decode[shares] ??= []).push(performance.now() - start);
            times.pieces[shares] = engine.groups.get(0).pieces;
            for (let i = 0; i < drawn; i++) {
                const seen = event("picture");
                engine.draw(i % engine.source.groups[0].frames, view);
                await seen;
                await new Promise((done) => setTimeout(done)); // the last message about it
                (times.project[shares] ??= []).push(engine.stats.project);
            }
        }
    }
    return { all, ...times };
}"""


# decodes group 0 in one instance: all of it, and the share of each of two workers, in turn; least ms of each
SHARES = """async (runs) => {
    const { Native, load } = await import("/native.js");
    const { engine } = document.querySelector("gsv-player");
    const { content } = engine.groups.get(0);
    const native = await Native.create(await load(new URL("/native.wasm.gz", location.href)));
    const orders = [[0, 1], [0, 2], [1, 2]].map(([k, n]) => content.orders(null, null, k, n)[0]);
    const times = orders.map((order) => ({ ...order, ms: Infinity }));
    for (let run = 0; run < runs; run++) {
        for (const own of times) {
            const start = performance.now();
            native.decode(0, own.payload, engine.source.level(0), { wanted: own.wanted, keepLeading: false });
            own.ms = Math.min(own.ms, performance.now() - start);
        }
    }
    return times.map(({ ms }) => ms);
}"""


def measure(browsers: Browsers, path: Path) -> dict:
    """The figures of one stream."""
    stream = open_stream(path)
    server = Server(path)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser = browsers.start("--disable-gpu")
    browser.goto(f"{server.url}?size={SIZE}&autoplay=off")
    browser.wait(f"{PLAYER}.camera && {PLAYER}.stats.gaussians > 0")
    whole, *shares = browser.page.evaluate(SHARES, RUNS)
    found = browser.page.evaluate(TIMES, [RUNS, DRAWN])
    server.shutdown()
    all_, frames = str(found["all"]), stream.groups[0]["frames"]
    entry = {"frames": frames, "gaussians": stream.group(0).count, "tiles": sum(map(len, stream.group(0).tiles()))}
    entry["workers"] = found["pieces"][all_]
    for what, per in (("decode", frames), ("project", 1)):
        one, shared = (statistics.median(found[what][n]) for n in ("1", all_))
        entry |= {f"{what}_ms_alone": round(one / per, 2), f"{what}_ms_shared": round(shared / per, 2)}
        entry[f"{what}_ratio"] = round(one / shared, 2)
    return entry | {"decode_ratio_of_shares": round(whole / max(shares), 2)}


def entries(folder: Path, names: list[str]) -> Iterator[dict]:
    """Measures the streams `names`, milliseconds per frame."""
    with Browsers() as browsers:
        for name, path in streams(folder, names).items():
            yield {"stream": name, **measure(browsers, path)}


def main() -> None:
    """Measures the streams named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the streams are made and kept")
    names = [*DEMOS, *STATUES]
    parser.add_argument("streams", nargs="*", metavar="STREAM", choices=names, default=["statue_all"])
    a = parser.parse_args()
    for entry in update_entries(RESULT, entries(a.folder, a.streams), key=lambda e: e["stream"]):
        print(json.dumps(entry), flush=True)


if __name__ == "__main__":
    main()

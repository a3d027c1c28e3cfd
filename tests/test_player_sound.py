"""Synchronisation of sound and pictures in the page, measured by a tone whose frequency tells the time.

Offset: the time of the tone that leaves the loudspeaker while a picture appears (clock of the AudioContext) minus the
time of the picture.
"""

import statistics
import subprocess

import pytest
from playing import PLAYER, load, notes, part, serving
from sounding import LOW, RISE, tone_stream, write_tone

from gscodec.decode import open_scene
from gscodec.decode.scene import Track
from gscodec.encode.tracks import TrackPlan, write_tracks
from gscodec.model.placement import Placement
from gscodec.player.server import Server

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

FPS, LENGTH = 100, 50  # stream: 2 s in 4 groups, frames of 10 ms
MOST = 0.04  # largest offset, seconds
PICTURES, TRIES = 9, 4  # a busy machine may be late once

LISTEN = f"""
window.listen = (player) => {{
  const {{ context, gain }} = player.sound;
  const ear = new AnalyserNode(context, {{ fftSize: 4096 }});
  gain.connect(ear);
  const all = new Float32Array(4096);
  const told = (from, to, speed) => {{ // [second of the tone, its place in `all`]
    const x = [];
    for (let i = from + 1; i < to; i++) {{
      if (all[i - 1] < 0 && all[i] >= 0) x.push(i - 1 + all[i - 1] / (all[i - 1] - all[i]));
    }}
    const frequency = ((x.length - 1) * context.sampleRate) / (x.at(-1) - x[0]) / speed;
    return [(frequency - {LOW}) / {RISE}, (x[0] + x.at(-1)) / 2];
  }};
  const offset = (t) => {{
    ear.getFloatTimeDomainData(all);
    const {{ speed }} = player;
    const [a, b] = [told(0, 2048, speed), told(2048, 4096, speed)];
    const steady = Math.abs(b[0] - a[0] - ((b[1] - a[1]) / context.sampleRate) * speed) < 0.01;
    const rendered = context.currentTime - (all.length - b[1]) / context.sampleRate;
    return steady ? b[0] + (player.sound.heard - rendered) * speed - t : null; // null: a start or a jump is in it
  }};
  window.offsets = (count) => new Promise((done) => {{
    const seen = [];
    player.addEventListener("picture", function look({{ detail }}) {{
      const found = offset(detail.t / player.fps);
      if (found !== null && !Number.isNaN(found)) seen.push(found);
      if (seen.length < count) return;
      player.removeEventListener("picture", look);
      done(seen);
    }});
  }});
  window.loudest = () => (ear.getFloatTimeDomainData(all), Math.max(...all.map(Math.abs)));
}};
"""


@pytest.fixture(scope="module")
def streams(tmp_path_factory):
    """Paths of a stream with Opus and one with AAC."""
    path, ffmpeg = tmp_path_factory.mktemp("sound"), imageio_ffmpeg.get_ffmpeg_exe()
    write_tone(path / "tone.wav", 3)
    for name in ("tone.opus", "tone.m4a"):
        subprocess.run([ffmpeg, "-v", "error", "-i", path / "tone.wav", path / name], check=True)
        tone_stream(path / f"{name}.gsv", path / name, fps=FPS, length=LENGTH)
    return [path / f"{name}.gsv" for name in ("tone.opus", "tone.m4a")]


@pytest.fixture(scope="module")
def page(browsers, streams):
    """Opens a stream: page(path or URL of another server)."""
    browser = browsers.start("--disable-gpu", "--disable-3d-apis", "--autoplay-policy=no-user-gesture-required")
    servers = {path: serving(Server(path)) for path in streams}

    def open_page(path=streams[0], **options):
        load(browser, servers[path].url, size="64x64", renderer="cpu", **options)
        browser.wait(f"{PLAYER}.sound?.context.state === 'running'")
        browser.eval(f"(() => {{ {LISTEN} listen({PLAYER}); }})()")
        return browser

    yield open_page
    for server in servers.values():
        server.shutdown()
        server.server_close()


def in_sync(browser) -> None:
    """Checks that sound and pictures are synchronous from now on."""
    found = []
    for _ in range(TRIES):
        found.append(statistics.median(browser.eval(f"offsets({PICTURES})")))
        if abs(found[-1]) <= MOST:
            return
    raise AssertionError(f"sound is off by {found} s")


def seek(browser, frame: int) -> None:
    bar = part(".seek input")
    browser.eval(f"(({bar}.value = {frame}), {bar}.dispatchEvent(new Event('input', {{ bubbles: true }})))")


def test_sound_keeps_to_the_pictures(page):
    """After play, seek, loop, pause and a change of speed."""
    browser = page()
    in_sync(browser)
    seek(browser, 120)
    in_sync(browser)
    seek(browser, 185)
    browser.wait(f"{PLAYER}.frame < 100")
    in_sync(browser)
    browser.eval(f"{PLAYER}.pause()")
    browser.wait("loudest() === 0")
    browser.eval(f"{PLAYER}.play()")
    in_sync(browser)
    browser.eval(f"{PLAYER}.setAttribute('speed', 0.5)")
    in_sync(browser)
    assert browser.errors == []
    assert notes(browser) == ""


def test_aac(page, streams):
    browser = page(streams[1])
    in_sync(browser)
    seek(browser, 60)
    in_sync(browser)


def test_the_rest_of_the_file_is_not_needed(page, streams, other):
    """The file is truncated, with and without its index."""
    data = streams[0].read_bytes()
    sidx = data.index(b"sidx") - 4
    whole = data[:sidx] + data[data.index(b"moof") - 4 :]
    for cut in (data[: int(0.6 * len(data))], whole[: int(0.6 * len(whole))]):
        url, _ = other(cut)
        browser = page(src=url)
        in_sync(browser)


def test_volume_and_mute(page):
    browser = page(volume="0.5")
    browser.wait("loudest() > 0.2")
    assert browser.eval("loudest()") < 0.3
    browser.eval(f"{part('.sound button')}.click()")
    browser.wait("loudest() === 0")
    assert browser.eval(f"{PLAYER}.hasAttribute('muted')")
    browser.eval(f"{PLAYER}.focus()")
    browser.key("m")
    browser.wait("loudest() > 0.2")
    slider = part(".sound input")
    browser.eval(f"(({slider}.value = 1), {slider}.dispatchEvent(new Event('input')))")
    browser.wait("loudest() > 0.4")
    browser.eval(f"{slider}.focus()")
    browser.key("ArrowLeft")
    assert browser.eval(f"{slider}.value") == "0.95"


def test_the_sound_of_a_hidden_track_plays_once_in_a_longer_scene(page, streams, other, tmp_path):
    stream = open_scene(streams[0]).tracks[0].stream
    placements = (Placement("hidden", hidden=True), Placement("late", offset=FPS))
    write_tracks(tmp_path / "scene.gsv", [TrackPlan.of(Track(stream, p)) for p in placements])
    url, _ = other((tmp_path / "scene.gsv").read_bytes())
    browser = page(src=url)
    seek(browser, 110)
    browser.wait("loudest() > 0.2")
    seek(browser, 240)
    assert browser.wait(f"{PLAYER}.frame > 260 && [loudest()]") == [0]


def test_sound_that_the_browser_cannot_decode_costs_the_sound_only(page, streams, other):
    data = streams[0].read_bytes()
    url, _ = other(data.replace(b"dOps\0\1", b"dOps\7\1", 1))
    browser = page(src=url)
    browser.wait(f"{part('.notes')}.innerText.includes('The sound cannot be played')")
    first = browser.eval(f"{PLAYER}.frame")
    browser.wait(f"{PLAYER}.frame !== {first}")


def test_a_stream_without_sound_has_no_controls_for_it(browser, server):
    load(browser, server.url, size="64x64")
    assert browser.eval(f"{PLAYER}.sound === null || {PLAYER}.sound === undefined")
    assert browser.eval(f"{part('.sound')} === null")

"""The player with damaged files, faulty servers, and servers of other origins."""

import http.server
import time

import numpy as np
import pytest
from playing import (
    FPS,
    GROUPS,
    LENGTH,
    PLAYER,
    Static,
    canvas,
    error_text,
    load,
    notes,
    part,
    psnr,
    sequence,
    serving,
    show,
)
from synthetic import encode_sequence

from gscodec.decode import open_stream
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.player.server import PAGE, Server
from gscodec.render.image import render_image


def test_a_file_from_another_server(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes())
    load(browser, server.url, src=url, size="160x120", autoplay="off")
    stream = open_stream(gsv)
    want = render_image(stream.frame(9), show(browser, 9), tuple(stream.config["background"]))
    assert psnr(canvas(browser), want) >= 35
    assert all(value.startswith("bytes=") for value in handler.log)


def test_the_element_on_another_page(browser, gsv, other, tmp_path):
    """Page, player and file on three origins; the element is removed and inserted again."""
    make = lambda *a, **k: Static(*a, directory=str(PAGE), **k)  # noqa: E731
    host = serving(http.server.ThreadingHTTPServer(("127.0.0.1", 0), make))
    file, _ = other(gsv.read_bytes())
    page = f"""<!doctype html><script type=module src="http://127.0.0.1:{host.server_address[1]}/page.js"></script>
        <gsv-player src="{file}" size="64x64" style="width: 300px; height: 200px"></gsv-player>"""
    url, _ = other(page.encode(), kind="text/html")
    browser.goto(url)
    playing = f"{PLAYER}.camera && {PLAYER}.stats.gaussians > 0"
    browser.wait(playing)
    assert browser.eval(f"{PLAYER}.paused"), "no autoplay was asked for"
    browser.eval(f"{{ const p = {PLAYER}; p.remove(); document.body.append(p); p.camera = null; }}")
    browser.wait(playing)
    assert browser.eval(f"{PLAYER}.getBoundingClientRect().height") == 200
    host.shutdown()


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A stream whose groups are larger than the first request."""
    path = tmp_path_factory.mktemp("large") / "large.gsv"
    config = stream_config(fps=1, sh_degree=0, gaussians=8000, frames=LENGTH)
    encode_sequence(sequence(8000), path, config, EncodeSettings(quality=95))
    return path


@pytest.mark.parametrize(("rate", "told", "quality"), [(20_000, 1, 1), (None, 0.05, 2)])
def test_the_representation_follows_the_rate_of_the_link(browser, server, gsv, other, rate, told, quality):
    """Two qualities of one capture; `rate` in bytes a second, None: unlimited. The manifest gives the bandwidths times
    `told`: an unlimited link suffices also on a busy machine."""
    s = sequence()
    small = gsv.with_name("small.gsv")
    if not small.exists():
        config = stream_config(fps=FPS, sh_degree=0, gaussians=400, frames=LENGTH)
        encode_sequence(s, small, config, EncodeSettings(quality=10))
    representations = []
    for path in (gsv, small):
        url, _ = other(path.read_bytes(), rate=rate)
        bandwidth = round(told * 8 * path.stat().st_size * FPS / (GROUPS * LENGTH))
        representations.append(f'<Representation bandwidth="{bandwidth}"><BaseURL>{url}</BaseURL></Representation>')
    manifest = f"""<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static"><Period>
        <AdaptationSet mimeType="video/mp4">{"".join(representations)}</AdaptationSet></Period></MPD>"""
    url, _ = other(manifest.encode(), kind="application/dash+xml", path="/a.mpd")
    load(browser, server.url, src=url, size="64x64", loop="off")
    browser.wait(f"{PLAYER}.frame > {2 * LENGTH}")
    show(browser, GROUPS * LENGTH - 1)
    assert browser.eval(f"{PLAYER}.engine.source.quality") == f"{quality} of 2"
    low = f"Object.assign({PLAYER}.engine.source, {{ representation: 0, link: LINK }})"
    for link, limited in ((1e-9, True), (1e9, False)):
        browser.eval(low.replace("LINK", str(link)))
        browser.wait(f"{part('.notes')}.innerText.includes('carries no more') === {str(limited).lower()}")


def test_layers_are_left_out_where_the_link_is_slow(browser, server, other, tmp_path):
    s = sequence(4000)
    path = tmp_path / "layers.gsv"
    config = stream_config(fps=15, sh_degree=0, gaussians=4000, frames=LENGTH)
    settings = EncodeSettings(quality=90, layers=3)
    encode_sequence(s, path, config, settings)
    url, handler = other(path.read_bytes(), rate=path.stat().st_size // GROUPS)  # a group takes 1 s, and plays 0.4 s
    load(browser, server.url, src=url, size="64x64", loop="off")
    text = browser.wait(f"{part('.notes')}.innerText")
    assert "of 3 layers: the link carries no more" in text
    browser.wait(f"{PLAYER}.paused")
    assert browser.eval(f"{PLAYER}.frame") == GROUPS * LENGTH - 1
    asked = [tuple(map(int, value[6:].split("-"))) for value in handler.log]
    asked = set().union(*(range(a, b + 1) for a, b in asked))  # some bytes twice: the first request is a guess
    assert len(asked) < 0.8 * path.stat().st_size
    group = open_stream(path).groups[-1]
    assert group["offset"] + group["size"] - 1 not in asked, "the last layer of the last group was left where it is"


def test_a_manifest_of_nothing(browser, server, other):
    url, _ = other(b"<MPD/>", path="/a.mpd")
    browser.goto(f"{server.url}?src={url}")
    assert "names no files" in error_text(browser)


def test_a_seek_fetches_what_it_needs(browser, server, other, large):
    """Groups are larger than the first request: a seek fetches the shown group and, of the others, only the next."""
    groups = open_stream(large).groups
    assert groups[0]["size"] > 70_000
    url, handler = other(large.read_bytes())
    load(browser, server.url, src=url, size="64x64", autoplay="off", loop="off")
    browser.eval(f"{PLAYER}.show({4 * LENGTH})")
    asked = [tuple(map(int, value[6:].split("-"))) for value in handler.log]
    touched = {
        i for i, g in enumerate(groups) for a, b in asked[1:] if a < g["offset"] + g["size"] and b >= g["offset"]
    }
    assert 4 in touched
    assert len(asked) < 8
    assert {0, 4} <= touched


def test_a_group_that_the_server_refuses_is_fetched_later(browser, server, other, large):
    url, handler = other(large.read_bytes())
    load(browser, server.url, src=url, size="64x64", autoplay="off", loop="off")
    handler.refused = True
    browser.eval(f"({PLAYER}.show({4 * LENGTH}), null)")
    browser.wait(f"{part('.notes')}.innerText.includes('cannot be fetched: The server answered 403')")
    handler.refused = False
    browser.wait(f"{PLAYER}.shown?.t === {4 * LENGTH}")
    assert notes(browser) == ""


def test_an_index_of_several_fragments_each_is_ignored(browser, server, gsv, other):
    data = bytearray(gsv.read_bytes())
    at = data.index(b"sidx") - 4
    size = int.from_bytes(data[at : at + 4], "big")
    head, (one, two, *others) = data[at : at + 40], np.frombuffer(data[at + 40 : at + size], ">u4").reshape(-1, 3)
    head[28:36] = (int.from_bytes(head[28:36], "big") + 12).to_bytes(8, "big")  # first_offset
    head[:4], head[38:40] = (size - 12).to_bytes(4, "big"), (1 + len(others)).to_bytes(2, "big")
    references = np.array([[one[0] + two[0], one[1] + two[1], one[2]], *others], ">u4").tobytes()
    data[at : at + size] = head + references + b"\0\0\0\x0cfree\0\0\0\0"
    url, _ = other(bytes(data))
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    browser.wait(f"{PLAYER}.frameCount === {GROUPS * LENGTH}")
    show(browser, LENGTH)
    assert notes(browser) == ""


def test_a_server_without_ranges(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes(), ranges=False)
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    show(browser, GROUPS * LENGTH - 1)
    assert len(handler.log) == 1


def test_a_server_that_drops_the_connection(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes(), drop_after=3000)
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    show(browser, GROUPS * LENGTH - 1)
    starts = [int(value[6:].split("-")[0]) for value in handler.log]
    assert {3000, 6000, 9000} <= set(starts), "it goes on where it broke"


def test_a_server_that_is_busy(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes(), fail_first=2)
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    assert len(handler.log) >= 3


def test_a_server_that_is_gone(browser, server):
    browser.goto(f"{server.url}?src=nothing.gsv")
    assert "not found" in error_text(browser)
    browser.goto(f"{server.url}?src=http://127.0.0.1:9/a.gsv")
    assert "Trying again" in browser.wait(f"{part('.notes')}.innerText")
    browser.goto(f"{server.url}?src=http://")
    assert '"http://" is not an address' in error_text(browser)
    browser.eval(f"{PLAYER}.removeAttribute('src')")
    assert browser.eval(f"{part('.error')}.hidden && {part('.busy')}.hidden")


def test_a_file_that_is_no_stream(browser, server, other):
    for data, word in (
        (b"not a stream at all, but long enough", "ftyp"),
        (b"", "empty"),
        (b"\0\0\0\x14ftypgsv1", "ends before"),
    ):
        url, _ = other(data)
        browser.goto(f"{server.url}?src={url}")
        assert word in error_text(browser)
        assert browser.eval(f"{part('[data-do=retry]')}.checkVisibility()")


def test_a_damaged_group_is_left_out(browser, server, gsv, other):
    data = bytearray(gsv.read_bytes())
    g = open_stream(gsv).groups[2]
    data[g["offset"] + g["size"] // 2] ^= 1
    url, _ = other(bytes(data))
    load(browser, server.url, src=url, size="64x64")
    browser.wait(f"{PLAYER}.frame > {3 * LENGTH}")
    text = notes(browser)
    assert f"Frames {2 * LENGTH}–{3 * LENGTH - 1} are damaged" in text
    assert "CRC" in text
    assert browser.eval(f"{part('.error')}.hidden")


def test_a_file_that_is_all_damage(browser, server, gsv, other):
    data = bytearray(gsv.read_bytes())
    for g in open_stream(gsv).groups:
        data[g["offset"] + g["size"] // 2] ^= 1
    url, _ = other(bytes(data))
    browser.goto(f"{server.url}?src={url}")
    assert "damaged" in error_text(browser)


@pytest.mark.parametrize("indexed", [True, False])
def test_a_truncated_file(browser, server, gsv, other, indexed):
    data = gsv.read_bytes()
    g = open_stream(gsv).groups[3]
    if not indexed:
        at = data.index(b"sidx")
        data = data[:at] + b"free" + data[at + 4 :]
    url, _ = other(data[: g["offset"] + 20])
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    assert browser.wait(f"{PLAYER}.frameCount >= {3 * LENGTH} && {PLAYER}.frameCount") == 3 * LENGTH
    show(browser, 3 * LENGTH - 1)
    text = notes(browser)
    assert (f"{3 * LENGTH} of {GROUPS * LENGTH} frames" if indexed else "still being written") in text


def test_a_growing_file(browser, tmp_path, gsv):
    """A file that grows as by an encoder, without index and cut anywhere."""
    data = gsv.read_bytes()
    at = data.index(b"sidx") - 4
    data = data[:at] + data[at + int.from_bytes(data[at : at + 4], "big") :]
    path = tmp_path / "live.gsv.part"
    first = len(data) // 3
    path.write_bytes(data[:first])
    s = serving(Server(path))
    load(browser, s.url, size="64x64")
    seen = browser.eval(f"{PLAYER}.frameCount")
    assert 0 < seen < GROUPS * LENGTH
    assert "still being written" in notes(browser)
    for end in (first + 10, first + 2000, len(data)):
        with open(path, "ab") as f:
            f.write(data[path.stat().st_size : end])
        time.sleep(0.3)
    browser.wait(f"{PLAYER}.frame >= {GROUPS * LENGTH - 1}")
    faster = (
        "{ const now = performance.now.bind(performance), t = now(); performance.now = () => t + 20 * (now() - t); }"
    )
    browser.eval(faster)
    browser.wait(f"{part('.notes')}.innerText.includes('has stopped growing')")
    assert "This device" not in notes(browser)
    s.shutdown()


def test_an_old_browser_is_told(browser, server):
    browser.call("Page.enable")
    script = browser.call("Page.addScriptToEvaluateOnNewDocument", source="WebAssembly.validate = () => false")
    browser.goto(server.url)
    assert "SIMD" in error_text(browser)
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script["identifier"])

import base64
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request

import numpy as np
import pytest
from PIL import Image

from ljn.demo import FRAMES
from ljn.pipeline.samples import find_samples
from ljn.system.overlay import draw_overlay
from ljn.system.recording import RgbdFrame
from ljn.system.system import ArSystem
from ljn.system.view import WebView

pytest.importorskip("viser", reason="viser is not installed: pip install -e '.[view]'")
connect = pytest.importorskip("websockets.sync.client").connect  # viser brings it


@pytest.fixture(scope="module")
def result(shipped):
    sample = find_samples(FRAMES)[0]
    depth = (sample.frames[0].read().depth / 1000).astype(np.float32)
    found = ArSystem(shipped, sample.camera)(RgbdFrame(0, "walking", depth))
    return found, draw_overlay(found, sample.camera), sample.camera


def test_the_page_is_served_and_shows_frames_that_went_well_and_that_failed(result):
    found, picture, camera = result
    with WebView(camera, port=18080) as view:
        view.show(found, picture)
        view.show(found._replace(prediction=None, error="there is no person"), picture)
        assert "there is no person" in view._text.content
        page = urllib.request.urlopen(view.url, timeout=10).read()
        assert b"<html" in page.lower()


@pytest.mark.browser
@pytest.mark.slow
def test_a_browser_draws_the_person(result, tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("there is no Chromium")
    found, picture, camera = result
    with WebView(camera, port=18090) as view:
        view.show(found, picture)
        for page in screenshots(browser, view.url, tmp_path / "profile", seconds=120):
            blue = (page[..., 2] > page[..., 0] + 30) & (page[..., 2] > 90)  # the mesh
            red = page[..., 0] > page[..., 1:].max(-1) + 60  # the bones
            if blue[:, :600].sum() > 500 and red[:, :600].sum() > 50:
                return
    pytest.fail(f"after two minutes the page shows {blue.sum()} pixels of mesh and {red.sum()} of bones")


def screenshots(browser, url, profile, seconds):
    """Pictures of a page, one a second, as long as a machine may take to draw it."""
    end = time.monotonic() + seconds
    process = subprocess.Popen(
        [
            *(browser, "--headless=new", "--no-sandbox", "--hide-scrollbars", "--window-size=1000,700"),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-port=0"),
            *(f"--user-data-dir={profile}", url),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port = profile / "DevToolsActivePort"
        while not (port.is_file() and len(port.read_text().split()) == 2):
            assert process.poll() is None, "the browser has stopped"
            assert time.monotonic() < end, "the browser did not start"
            time.sleep(0.2)
        targets = f"http://127.0.0.1:{port.read_text().split()[0]}/json"
        with urllib.request.urlopen(targets, timeout=60) as answer:
            [page] = [target for target in json.load(answer) if target["type"] == "page"]
        with connect(page["webSocketDebuggerUrl"], max_size=None, open_timeout=60) as devtools:
            for number in itertools.takewhile(lambda _: time.monotonic() < end, itertools.count()):
                devtools.send(json.dumps({"id": number, "method": "Page.captureScreenshot"}))
                answer = json.loads(devtools.recv(timeout=60))
                picture = Image.open(io.BytesIO(base64.b64decode(answer["result"]["data"])))
                yield np.asarray(picture.convert("RGB")).astype(int)
                time.sleep(1)
    finally:
        process.kill()
        process.wait()

import shutil
import subprocess
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
        path = tmp_path / "page.png"
        subprocess.run(
            [
                *(browser, "--headless=new", "--no-sandbox", "--hide-scrollbars", "--window-size=1000,700"),
                *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", f"--screenshot={path}"),
                *("--timeout=15000", "--virtual-time-budget=15000", view.url),
            ],
            check=True,
            timeout=120,
            capture_output=True,
        )
    page = np.asarray(Image.open(path).convert("RGB")).astype(int)
    blue = (page[..., 2] > page[..., 0] + 30) & (page[..., 2] > 90)  # the mesh
    red = page[..., 0] > page[..., 1:].max(-1) + 60  # the bones
    assert blue[:, :600].sum() > 500
    assert red[:, :600].sum() > 50

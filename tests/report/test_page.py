import base64
import io
import json
import re
import shutil
import struct
import subprocess
import zlib
from html.parser import HTMLParser

import pytest
from PIL import Image

from ljn.report import write_report

VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Elements with their attributes; fails where a tag is not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.elements = []
        self._open = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def all(self, name):
        return [attributes for tag, attributes in self.elements if tag == name]


@pytest.fixture
def html(table_3_2):
    write_report(table_3_2)
    return (table_3_2 / "report.html").read_text()


def test_the_page_asks_for_nothing_from_elsewhere(html):
    page = Page(html)
    assert not re.search(r"https?://|url\(|@import|@font-face", html)
    assert not page.all("script")
    for _, attributes in page.elements:
        for name in ("src", "href", "srcset", "xlink:href", "action"):
            assert attributes.get(name, "data:").startswith(("data:", "#"))
    policies = [meta for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in policies[0]["content"]


def test_links_within_the_page_lead_somewhere(html):
    page = Page(html)
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {link["href"][1:] for link in page.all("a")} <= set(ids)


def test_the_page_is_readable_on_a_phone_and_in_both_colour_schemes(html):
    assert 'name="viewport"' in html
    assert "prefers-color-scheme: dark" in html
    parts = html.split("prefers-color-scheme: dark")[:2]
    light, dark = (set(re.findall(r"(--[a-z0-9-]+): #", part)) for part in parts)
    assert light == dark
    assert set(re.findall(r"var\((--[a-z0-9-]+)\)", html)) - light == {"--c"}
    page = Page(html)
    scrolled = [attributes for attributes in page.all("div") if attributes.get("class") == "scroll"]
    assert len(scrolled) == len(page.all("table"))


def test_names_and_errors_are_escaped(sweep):
    evil = '<script>alert("x")</script>'
    sweep.run(evil, {"mpjpe": 60.0}, overrides=(f"name={evil}",), device=evil, commit=evil)
    sweep.run(evil, {"mpjpe": 50.0}, overrides=("name=b",))
    sweep.job(evil, status="failed", error=evil)
    write_report(sweep.write(name=evil, command=evil, preset=evil))
    html = (sweep.directory / "report.html").read_text()
    assert not Page(html).all("script")
    assert "&lt;script&gt;" in html


def test_every_table_row_and_failure_is_there(html):
    for text in (
        "Table 3.2",
        "proposed without EDM",
        '<td class="thesis">24.2</td><td class="ours">60.5 <span class="sd">± 0.7</span></td><td>+36.3</td>',
        '<td class="word">FAILED</td>',
        "ValueError: &lt;script&gt;",
        "holds in all 6 comparisons",
        "python run.py",
    ):
        assert text in html


def test_every_run_s_origin_is_there(html):
    for text in (
        *("c0ffee12", "0123456789</span>, with changes", "feed5eed", "dddd4444", "1 h 02 min", "1,006,757"),
        *("12,000", "aaaa1111", "embedded", "CC0"),
    ):
        assert text in html


def counts(html):
    """The headings of the table of the data's counts with their columns, and its rows."""
    table = re.search(r'aria-label="Numbers of data".*?</table>', html, re.DOTALL)[0]
    lines = [re.findall(r"<t[hd]([^>]*)>(?:<span[^>]*>)?([^<]*)", line) for line in table.split("<tr>")[1:]]
    spans = {text: int(re.search('colspan="(.)"', tag)[1]) for tag, text in lines[0] if text}
    return spans, [[text for _, text in line] for line in lines[2:]]


def test_the_data_s_counts_stand_beside_those_of_table_3_1(html):
    spans, rows = counts(html)
    assert spans == {"subjects": 1, "sequences": 1, "clips": 2, "frames": 2, "samples": 2}
    assert rows == [
        ["train", "115", "1,964", "55,001", "13", "5,342,090", "2,129", "60,000", "12,000", "aaaa1111"],
        ["validation", "–", "–", "–", "4", "–", "258", "5,000", "500", "bbbb2222"],
        ["test", "30", "703", "12,528", "5", "1,194,662", "1,238", "15,000", "2,000", "cccc3333"],
    ]
    assert "<dt>bodies</dt><dd>female, male</dd>" in html


def data_of(folder, **changes):
    path = folder / "record.json"
    record = json.loads(path.read_text())
    record["data"] |= changes
    path.write_text(json.dumps(record))


def test_counts_that_records_lack_are_left_out(sweep):
    data_of(sweep.run("detector/basic", {"mpjpe_eq38": 60.0}), motion=None)
    write_report(sweep.write("table_3_2"))
    spans, rows = counts((sweep.directory / "report.html").read_text())
    assert spans == {"subjects": 1, "sequences": 1, "clips": 1, "frames": 1, "samples": 2}
    assert rows[0] == ["train", "115", "1,964", "55,001", "5,342,090", "60,000", "12,000", "aaaa1111"]


def test_an_older_record_of_the_same_data_shares_the_counts_of_a_newer_one(sweep):
    data_of(sweep.run("detector/basic", {"mpjpe_eq38": 60.0}), motion=None)
    sweep.run("detector/proposed", {"mpjpe_eq38": 50.0})
    write_report(sweep.write("table_3_2"))
    html = (sweep.directory / "report.html").read_text()
    assert counts(html)[0]["clips"] == 2
    assert "<caption>2 runs</caption>" in html


def test_splits_that_an_evaluation_does_not_read_have_dashes_for_its_counts(sweep):
    changes = {"sizes": {"test": 7}, "pool": {"test": "cccc"}, "motion": {"test": {"clips": 5}}}
    data_of(sweep.run("detector/cross_0px", {"mpjpe_eq38": 60.0}), **changes)
    write_report(sweep.write("table_3_3_cross"))
    _, rows = counts((sweep.directory / "report.html").read_text())
    assert [row[-2:] for row in rows] == [["–", "–"], ["–", "–"], ["7", "cccc"]]


def test_an_evaluation_names_the_run_that_it_evaluates(sweep):
    checkpoint = {"path": "best.ckpt", "hash": "beef0001", "epoch": 12}
    changes = {"trained_by": "proposed-small-1", "checkpoint": checkpoint, "num_parameters": None}
    sweep.run("detector/cross_0px", {"mpjpe_eq38": 60.0}, **changes)
    write_report(sweep.write("table_3_3_cross"))
    html = (sweep.directory / "report.html").read_text()
    assert "proposed-small-1" in html
    assert "beef0001" in html


def test_pictures_are_embedded_once_a_row_small_and_with_words(html):
    images = Page(html).all("img")
    assert len(images) == 4
    for image in images:
        assert image["alt"].startswith("Best, median and worst test samples of detector/")
        data = base64.b64decode(image["src"].removeprefix("data:image/png;base64,"))
        with Image.open(io.BytesIO(data)) as opened:
            opened.load()
            assert opened.size == (1600, 80)


def huge_png():
    """A picture that says it has 60,000 x 60,000 pixels."""
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunks = {b"IHDR": header, b"IDAT": zlib.compress(bytes(99))}
    packed = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks.items()
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@pytest.mark.parametrize(
    "content",
    [b"\x89PNG\r\n\x1a\n cut off", huge_png(), b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"],
)
def test_a_damaged_picture_is_left_out_with_a_warning(sweep, monkeypatch, content):
    def start_ghostscript(*arguments, **options):
        raise AssertionError("a picture started Ghostscript")

    monkeypatch.setattr(subprocess, "Popen", start_ghostscript)
    folder = sweep.run("detector/basic", {"mpjpe_eq38": 60.0})
    (folder / "pictures" / "test_best_median_worst.png").write_bytes(content)
    with pytest.warns(UserWarning, match="is left out of the report"):
        write_report(sweep.write("table_3_2"))
    assert not Page((sweep.directory / "report.html").read_text()).all("img")


def test_curves_over_the_axis_have_error_bars_and_the_thesis_dashed(sweep):
    for seed in (0, 1):
        folder = sweep.run("detector/sigma_5px", {"mpjpe_eq38": 60.0 + seed, "pckh": 50.0}, seed)
        (folder / "config.yaml").write_text("data:\n  synthesis:\n    keypoint_noise_px: 5\n")
    folder = sweep.run("detector/proposed", {"mpjpe_eq38": 70.0, "pckh": 40.0})
    (folder / "config.yaml").write_text("data:\n  synthesis:\n    keypoint_noise_px: 10\n")
    write_report(sweep.write("table_3_3"))
    html = (sweep.directory / "report.html").read_text()
    assert "<title>ours, 5: 60.5 ± 0.7</title>" in html
    assert "<title>thesis, 15: 31.4</title>" in html
    charts = html.split('<figure class="chart">')[1:]
    assert [re.search(r"<figcaption>([^<]*)", chart)[1] for chart in charts] == [
        "MPJPE by σ of the 2D joints&#x27; noise, px",
        "PCKh by σ of the 2D joints&#x27; noise, px",
        "Validation MPJPE while training",
    ]
    assert 'class="bar"' in charts[0]
    assert "dashed" in charts[0]


def test_a_run_of_which_nothing_is_left_is_said_to_be_missing(sweep):
    shutil.rmtree(sweep.run("detector/basic", {"mpjpe_eq38": 60.0}))
    write_report(sweep.write("table_3_2"))
    html = (sweep.directory / "report.html").read_text()
    assert "MISSING run-0: it left no test metrics" in html
    assert "no run left a record of its data" in html
    assert not re.search(r"<td[^>]*></td>", html)


@pytest.mark.parametrize(
    "name", ["record.json", "config.yaml", "csv/version_0/metrics.csv", "test_errors.npz"]
)
@pytest.mark.parametrize("content", [None, b"", b"{", b"[1]", b"\xff\xfe\x00"])
def test_missing_and_damaged_files_of_a_run_stop_nothing(sweep, name, content):
    path = sweep.run("detector/proposed", {"mpjpe_eq38": 60.0, "pckh": 50.0}, errors=[1.0, 2.0]) / name
    path.unlink() if content is None else path.write_bytes(content)
    assert "60.0" in write_report(sweep.write("table_3_4")).text


def test_a_sweep_without_jobs_has_a_page(sweep):
    report = write_report(sweep.write("table_3_2"))
    assert "missing" in report.text
    Page((sweep.directory / "report.html").read_text())


@pytest.fixture
def open_in_browser(tmp_path):
    """Opens a file in Chromium without network: the document afterwards, and the addresses that it asked for."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next((path for path in map(shutil.which, names) if path), None)
    if browser is None:
        pytest.skip("needs Chromium: none of chromium, chromium-browser, google-chrome is on the path")
    options = (
        *("headless", "no-sandbox", "disable-gpu", "no-first-run", "disable-quic", "disable-sync"),
        *("disable-background-networking", "disable-component-update", "host-resolver-rules=MAP * ~NOTFOUND"),
        *(f"user-data-dir={tmp_path / 'profile'}", f"log-net-log={tmp_path / 'net.json'}", "dump-dom"),
    )

    def open_file(path):
        command = [browser, *(f"--{option}" for option in options), path.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        log = json.loads((tmp_path / "net.json").read_text())
        events = [event.get("params", {}) for event in log["events"]]
        # The browser's own requests, for its updates and the like, come from no page.
        none = "not an origin"
        asked = {event["url"] for event in events if event.get("initiator", none) != none}
        return done.stdout, {url for url in asked if not url.startswith(("file:", "data:"))}

    return open_file


@pytest.mark.browser
def test_a_browser_shows_all_of_it_and_asks_for_nothing(table_3_2, open_in_browser):
    write_report(table_3_2)
    document, asked = open_in_browser(table_3_2 / "report.html")
    page = Page(document)
    assert len(page.all("table")) == 4  # Table 3.2, its comparisons, the data, the runs
    assert len(page.all("img")) == 4
    assert asked == set()


@pytest.mark.browser
def test_a_request_of_a_page_would_be_seen(tmp_path, open_in_browser):
    path = tmp_path / "page.html"
    path.write_text('<img src="http://elsewhere.invalid/picture.png">')
    assert open_in_browser(path)[1] == {"http://elsewhere.invalid/picture.png"}

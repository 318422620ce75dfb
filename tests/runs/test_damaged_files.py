import copy
import json
import random
import time

import pytest

from ljn.report import write_report
from ljn.runs.files import read_json, read_metrics
from ljn.runs.record import RunRecord, is_complete
from ljn.runs.sweep import read_jobs

DEEP = "[" * 100_000 + "]" * 100_000
ODD = (
    *(
        None,
        True,
        0,
        -1,
        10**400,
        1e999,
        -1e308,
        float("nan"),
        "",
        "\x00",
        "\ud800",
        "a" * 5000,
        "../..",
        "<b>",
    ),
    *([], {}, [[]], [None], ["\ud800"], {"a": {"b": []}}, "DEEP"),
)
JOB = {
    "experiment": "detector/basic",
    "overrides": ["seed=0"],
    "seed": 0,
    "status": "complete",
    "error": None,
}
SWEEP = {"name": "mine", "preset": "small", "tables": [], "command": "python run.py"}
RECORD = {
    **{"status": "complete", "config_hash": "c0ffee", "commit": "0123", "is_dirty": True, "wall_time_s": 3.5},
    **{"attempts": 1, "num_parameters": 10, "stage": "detector"},
    "metrics": {"mpjpe": {"unit": "mm", "goal": "min"}},
    "headline": ["mpjpe"],
    "truth": ["joints"],
    "is_root_relative": True,
    "versions": {"python": "3.11"},
    "data": {
        "source": "embedded",
        "sizes": {"train": 1},
        "motion": {"train": {"clips": 1}},
        "pool": {"test": "aa"},
        "bodies": {"male": "bb"},
        "detector": {"hash": "cc"},
    },
}


def write_sweep(directory):
    jobs = [JOB | {"run_dir": f"run-{number}", "seed": number} for number in (0, 1)]
    contents = {"sweep.json": SWEEP | {"jobs": jobs}}
    for number in (0, 1):
        (directory / f"run-{number}").mkdir(exist_ok=True)
        contents[f"run-{number}/record.json"] = RECORD
        contents[f"run-{number}/metrics.json"] = {"test/mpjpe": 60.0 + number, "val/mpjpe": 3}
    for name, content in contents.items():
        (directory / name).write_text(json.dumps(content))
    return contents


def places(value, way=()):
    yield way
    if isinstance(value, list):
        value = dict(enumerate(value))
    for key, entry in value.items() if isinstance(value, dict) else ():
        yield from places(entry, (*way, key))


def damaged(content, generator):
    """A file's bytes with a value of another kind in one place, or with bytes changed, cut off or repeated."""
    if generator.random() < 0.7:
        way = generator.choice(list(places(content)))
        odd = generator.choice(ODD)
        holder = {"root": copy.deepcopy(content)}
        node = holder
        for key in ("root", *way)[:-1]:
            node = node[key]
        node[("root", *way)[-1]] = odd
        return json.dumps(holder["root"]).replace('"DEEP"', DEEP).encode()
    data = bytearray(json.dumps(content).encode())
    for _ in range(generator.randint(1, 4)):
        place = generator.randrange(len(data))
        kind = generator.randrange(3)
        if kind == 0:
            data[place] = generator.randrange(256)
        elif kind == 1:
            del data[place : place + generator.randint(1, 20)]
        else:
            data[place:place] = data[place : place + 10] * 3
        data = data or bytearray(b" ")
    return bytes(data)


@pytest.mark.parametrize("name", ["sweep.json", "run-0/record.json", "run-0/metrics.json"])
def test_damaged_files_are_refused_in_our_words_or_count_as_missing(tmp_path, name):
    content = write_sweep(tmp_path)[name]
    generator = random.Random(name)
    for _ in range(150):
        data = damaged(content, generator)
        (tmp_path / name).write_bytes(data)
        refusal = "none"
        try:
            write_report(tmp_path)
        except Exception as error:
            refusal = f"{type(error).__name__}: {error}"
        ours = ("none", f"ValueError: '{tmp_path / name}': expected", "ValueError: tables: expected")
        assert refusal.startswith(ours), (refusal[:500], data[:500])
        read_jobs(tmp_path)
        is_complete(tmp_path / "run-0", "c0ffee")
        RunRecord(tmp_path / "run-0", {})
        metrics = read_metrics(tmp_path / "run-0")
        assert metrics is None or all(isinstance(value, float) for value in metrics.values())


@pytest.mark.parametrize(
    "content",
    [DEEP, '{"a": ' * 40 + "1" + "}" * 40, '{"a": "\\ud800"}', '{"a": "' + "b" * 2**24 + '"}', "[1]"],
)
def test_json_of_absurd_depth_size_or_text_counts_as_damaged(tmp_path, content):
    path = tmp_path / "record.json"
    path.write_text(content)
    started = time.monotonic()
    assert read_json(path) is None
    assert time.monotonic() - started < 5

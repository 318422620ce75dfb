import json
import signal
import subprocess
import sys
import threading
import time

import pytest

from ljn.runs.files import read_json, write_json
from ljn.runs.record import RunRecord, alone_in, is_complete


def test_a_record_says_running_then_complete(tmp_path):
    with RunRecord(tmp_path, {"name": "x"}) as record:
        assert read_json(tmp_path / "record.json")["status"] == "running"
        record.add(device="cpu")
    record = read_json(tmp_path / "record.json")
    assert record["status"] == "complete"
    assert record["device"] == "cpu"
    assert record["name"] == "x"
    assert {
        "commit",
        "is_dirty",
        "versions",
        "machine",
        "wall_time_s",
        "started",
        "record_version",
    } <= record.keys()


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (KeyboardInterrupt(), "interrupted"),
        (SystemExit(1), "interrupted"),
        (RuntimeError("broken"), "failed"),
    ],
)
def test_a_record_says_how_a_run_ended(tmp_path, error, status):
    with pytest.raises(type(error)), RunRecord(tmp_path, {}):
        raise error
    record = read_json(tmp_path / "record.json")
    assert record["status"] == status
    assert record.get("error") == ("RuntimeError: broken" if status == "failed" else None)


def test_a_second_attempt_is_counted_and_its_time_added(tmp_path):
    write_json(tmp_path / "record.json", {"wall_time_s": 100.0, "attempts": 1, "status": "running"})
    with RunRecord(tmp_path, {}):
        pass
    record = read_json(tmp_path / "record.json")
    assert record["attempts"] == 2
    assert record["wall_time_s"] >= 100


def test_a_killed_process_leaves_a_valid_record_that_says_running(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path; from ljn.runs.record import RunRecord\n"
        "with RunRecord(Path(sys.argv[1]), {}): os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], timeout=60)
    assert done.returncode == -signal.SIGKILL
    assert read_json(tmp_path / "record.json")["status"] == "running"


def test_json_holds_no_nan_and_no_half_written_file(tmp_path):
    write_json(tmp_path / "metrics.json", {"a": float("nan"), "b": [float("inf"), 1.0]})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"a": None, "b": [None, 1.0]}
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]
    (tmp_path / "metrics.json").write_text('{"a": 1')
    assert read_json(tmp_path / "metrics.json") is None


def test_a_run_is_complete_only_with_its_own_hash_and_metrics(tmp_path):
    write_json(tmp_path / "record.json", {"status": "complete", "config_hash": "abc"})
    assert not is_complete(tmp_path, "abc")
    write_json(tmp_path / "metrics.json", {})
    assert is_complete(tmp_path, "abc")
    assert not is_complete(tmp_path, "def")


def test_a_second_run_in_a_directory_waits_for_the_first(tmp_path):
    order = []

    def second():
        with alone_in(tmp_path / "run"):
            order.append("second")

    with alone_in(tmp_path / "run"):
        thread = threading.Thread(target=second)
        thread.start()
        time.sleep(0.3)
        order.append("first")
    thread.join(10)
    assert order == ["first", "second"]

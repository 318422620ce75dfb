import errno
import json
import logging
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from ljn.runs.files import path_part, read_json, write_json
from ljn.runs.processes import Interruption
from ljn.runs.record import RunRecord, alone_in, is_complete


def test_a_record_says_running_then_complete(tmp_path):
    with RunRecord(tmp_path, {"name": "x"}) as record:
        assert read_json(tmp_path / "record.json")["status"] == "running"
        record.add(device="cpu")
    record = read_json(tmp_path / "record.json")
    assert (record["status"], record["device"], record["name"]) == ("complete", "cpu", "x")
    known = {"commit", "is_dirty", "versions", "machine", "wall_time_s", "started", "record_version"}
    assert known <= record.keys()


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (KeyboardInterrupt(), "interrupted"),
        (Interruption(signal.SIGTERM), "interrupted"),
        (RuntimeError("broken"), "failed"),
    ],
)
def test_a_record_says_how_a_run_ended(tmp_path, error, status):
    with pytest.raises(type(error)), RunRecord(tmp_path, {}):
        raise error
    record = read_json(tmp_path / "record.json")
    assert record["status"] == status
    assert record.get("error") == ("RuntimeError: broken" if status == "failed" else None)


def test_a_data_worker_that_the_same_signal_ended_is_no_error_of_the_run(tmp_path):
    def fit():
        try:
            raise Interruption(signal.SIGTERM)
        finally:
            raise RuntimeError("DataLoader worker (pid 3) is killed by signal: Terminated.")

    with pytest.raises(Interruption) as ended, RunRecord(tmp_path, {}):
        fit()
    assert ended.value.code == 143
    assert json.loads((tmp_path / "record.json").read_text())["status"] == "interrupted"


def test_a_second_attempt_is_counted_and_its_time_added(tmp_path):
    write_json(tmp_path / "record.json", {"wall_time_s": 100.0, "attempts": 1, "status": "running"})
    with RunRecord(tmp_path, {}):
        pass
    record = read_json(tmp_path / "record.json")
    assert record["attempts"] == 2
    assert record["wall_time_s"] >= 100


@pytest.mark.parametrize(
    ("number", "returncode", "status"),
    [
        (signal.SIGKILL, -signal.SIGKILL, "running"),
        (signal.SIGTERM, 143, "interrupted"),
        (signal.SIGINT, 130, "interrupted"),
    ],
)
def test_a_signal_leaves_a_valid_record_and_the_exit_code_that_shells_expect(
    tmp_path, number, returncode, status
):
    code = (
        "import os, sys; from pathlib import Path\n"
        "from ljn.runs.processes import end_on_signals; from ljn.runs.record import RunRecord\n"
        "end_on_signals()\n"
        "with RunRecord(Path(sys.argv[1]), {}):\n"
        "    try: os.kill(os.getpid(), int(sys.argv[2]))\n"
        "    finally: os.kill(os.getpid(), int(sys.argv[2]))"  # a second one does not disturb the end
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path), str(int(number))], timeout=60)
    assert done.returncode == returncode
    assert read_json(tmp_path / "record.json")["status"] == status


def test_a_full_disk_leaves_the_old_file_no_draft_and_the_first_error(tmp_path, monkeypatch, caplog):
    write = Path.write_bytes

    def half(path, data):
        write(path, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    write_json(tmp_path / "metrics.json", {"a": 1})
    record = RunRecord(tmp_path, {}).__enter__()
    monkeypatch.setattr(Path, "write_bytes", half)
    for write_something in (lambda: write_json(tmp_path / "metrics.json", {"a": 2}), record.__enter__):
        with pytest.raises(OSError, match="No space left"):
            write_something()
    error = RuntimeError("broken")
    with caplog.at_level(logging.WARNING):
        record.__exit__(RuntimeError, error, None)  # does not raise
    assert "No space left on device" in caplog.text
    assert read_json(tmp_path / "metrics.json") == {"a": 1}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["metrics.json", "record.json"]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("detector/proposed", "detector-proposed"),
        ("v1.0, two words", "v1.0, two words"),
        ("../../up", "--..-up"),
        ("/absolute", "-absolute"),
        (r"C:\up", "C:-up"),
        ("..", "-"),
        (".hidden", "-hidden"),
        ("", "-"),
        ("zero\0, line\n", "zero-, line-"),
        ("x" * 300, "x" * 100),
    ],
)
def test_no_name_leads_to_another_directory(text, part, tmp_path):
    assert path_part(text) == part
    assert (tmp_path / part).resolve().parent == tmp_path.resolve()


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

"""Locks of what one process writes: who holds one, and what becomes of it after a crash."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

from jaxbeam.runtime import output_file as locks
from jaxbeam.runtime.output_file import InUseError, lock_file, writer_lock

HOLD = """
import sys, time, pathlib
from jaxbeam.runtime.output_file import writer_lock
with writer_lock(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def holder(path) -> subprocess.Popen:
    """A process that holds the lock of a path."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout as output:
        assert output.readline() == b"held\n"
    return process


def test_error_says_who_writes_and_since_when(tmp_path):
    path = tmp_path / "runs.zarr"
    process = holder(path)
    try:
        with pytest.raises(InUseError) as raised, writer_lock(path):
            pass
        expected = (
            rf"{re.escape(str(path))} is being written by process {process.pid} on .+ since"
            r" \d{4}-\d\d-\d\d \d\d:\d\d:\d\d.* \(last sign of life \d s ago\): wait until it ends,"
            " stop it, or choose another name; .*"
        )
        assert re.fullmatch(expected, str(raised.value))
    finally:
        process.kill()
    # Killed and not waited for, a process is still listed, as a zombie.
    deadline = time.monotonic() + 10
    while locks._start_time(process.pid) is not None and time.monotonic() < deadline:
        time.sleep(0.01)
    with writer_lock(path):
        pass
    process.wait()
    assert not list(tmp_path.iterdir())


def test_process_number_given_anew_does_not_keep_a_lock(tmp_path):
    path = tmp_path / "runs.zarr"
    content = locks._this_process() | {"start": locks._start_time(os.getpid()) - 1}
    lock_file(path).write_text(json.dumps(content))
    with writer_lock(path):
        assert json.loads(lock_file(path).read_text())["token"] != content["token"]


def test_locks_of_other_machines_end_by_silence(tmp_path, monkeypatch):
    path, lock = tmp_path / "runs.zarr", lock_file(tmp_path / "runs.zarr")
    lock.write_text(json.dumps(locks._this_process() | {"machine": "another", "host": "node7"}))
    with pytest.raises(InUseError, match="on node7 since .* ends 120 s after"), writer_lock(path):
        pass
    old = time.time() - 130
    os.utime(lock, (old, old))
    with writer_lock(path):
        pass
    lock.write_bytes(b"")  # a crash in the very first moment, without links
    with pytest.raises(InUseError, match="by another process"), writer_lock(path):
        pass
    os.utime(lock, (old, old))
    monkeypatch.setattr(locks, "SIGN_OF_LIFE", 0.01)
    with writer_lock(path):
        first = lock.stat().st_mtime_ns
        time.sleep(0.2)
        assert lock.stat().st_mtime_ns > first
    assert not list(tmp_path.iterdir())


def test_one_of_many_threads_takes_a_lock_over(tmp_path):
    """All find the lock of a process that has ended at one time; one holds it at a time."""
    path, inside, most, refused = tmp_path / "runs.zarr", [], [], []
    stale = locks._this_process() | {"start": 0}
    barrier = threading.Barrier(8)

    def write():
        for _ in range(20):
            barrier.wait()
            try:
                with writer_lock(path):
                    inside.append(1)
                    most.append(len(inside))
                    time.sleep(0.001)
                    inside.pop()
            except InUseError:
                refused.append(1)
            if barrier.wait() == 0:
                lock_file(path).write_text(json.dumps(stale))

    threads = [threading.Thread(target=write) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1
    assert len(most) >= 20
    assert len(most) + len(refused) == 160


def test_file_systems_without_links(tmp_path, monkeypatch):
    def no_links(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "runs.zarr"
    held = pytest.raises(InUseError, match=f"process {os.getpid()} on")
    with writer_lock(path), held, writer_lock(path):
        pass
    assert not list(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError), writer_lock(tmp_path / "none" / "runs.zarr"):
        pass


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs signals")
def test_stopped_process_keeps_its_lock(tmp_path):
    path = tmp_path / "runs.zarr"
    process = holder(path)
    try:
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(InUseError), writer_lock(path):
            pass
    finally:
        process.kill()
        process.wait()

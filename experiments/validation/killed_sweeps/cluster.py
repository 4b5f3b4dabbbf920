"""A Dask cluster of processes of this machine, each of which may be killed and started anew."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[3]
START = 120.0  # s, within which a process starts


class Cluster:
    """A scheduler and some workers, in a folder; `environment` is that of the workers."""

    def __init__(self, folder: Path, workers: int, environment: dict[str, str]):
        self._folder, self._environment = folder, environment
        self._file, self._log = folder / "scheduler.json", (folder / "cluster.log").open("ab")
        self.scheduler: subprocess.Popen | None = None
        self.workers: list[subprocess.Popen | None] = [None] * workers

    def start(self) -> str:
        """Start all processes that do not run, and wait for the scheduler; returns its address.

        Raises RuntimeError if no scheduler starts.
        """
        if self.scheduler is None or self.scheduler.poll() is not None:
            self._file.unlink(missing_ok=True)
            self.scheduler = self._process("distributed.cli.dask_scheduler", "--port", "0")
        end = time.monotonic() + START
        while not self._file.exists() or not self._file.read_text():
            if time.monotonic() > end or self.scheduler.poll() is not None:
                raise RuntimeError(f"no scheduler started: see {self._log.name}")
            time.sleep(0.05)
        module = "experiments.validation.killed_sweeps.disk"
        for i, worker in enumerate(self.workers):
            if worker is None or worker.poll() is not None:
                self.workers[i] = self._process(module, "--nthreads", "1", "--no-nanny")
        return json.loads(self._file.read_text())["address"]

    def close(self) -> None:
        """Kill all processes."""
        for process in (*self.workers, self.scheduler):
            if process is not None:
                kill(process)
        self._log.close()

    def _process(self, module: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", module, "--no-dashboard"]
        return subprocess.Popen(
            [*command, "--scheduler-file", str(self._file), *options],
            cwd=self._folder,
            env=os.environ | {"PYTHONPATH": str(ROOT)} | self._environment,
            stdout=self._log,
            stderr=self._log,
        )


def kill(process: subprocess.Popen) -> None:
    """End a process at once, as a crash or a lack of memory does."""
    if process.poll() is None:
        process.send_signal(signal.SIGKILL)
        process.wait()

"""Kill workers, scheduler and client of sweeps on a cluster at random; exit with 1 if a law breaks.

    python -m experiments.validation.killed_sweeps [SEED ...] [--workers 4] [--blocks 40]

A sweep is begun on a Dask cluster of this machine and resumed until it is complete. After a random
time a worker, the scheduler or the client gets SIGKILL, or several do; what was killed is started
anew. Disks of the workers are slow, full for some of the writes, and their clocks differ by hours.
Laws: a client that is not killed ends, in one sentence if not in success; no finished block is
lost; the store in the end has the bytes of a sweep on one machine without any of this.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tomli_w

import jaxbeam as jb
from experiments.benchmarks.common import print_row, print_table
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.simulation.sweeps.store import block_places

ROOT = Path(__file__).parents[3]
START = 120.0  # s, within which a process of the cluster starts
KILLS = 6  # of a sweep
LONGEST = 240.0  # s without a finished block, within which a client ends
CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=3),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.5, speed=1.0)],
    run=jb.Run(duration=0.5),
)


class KilledSweep(NamedTuple):
    """Outcome of a sweep: processes killed, messages of clients, and the laws that it broke."""

    killed: Counter
    said: Counter
    faults: list[str]


def files_of(store: Path) -> dict[str, bytes]:
    """Every file of a store."""
    files = (path for path in sorted(store.rglob("*")) if path.is_file())
    return {str(path.relative_to(store)): path.read_bytes() for path in files}


def finished(store: Path) -> set[int]:
    """Numbers of the finished blocks of a store."""
    files = store.glob("blocks/*/*.blocks")
    with contextlib.suppress(FileNotFoundError):  # the sweep has ended in between
        return {place.block for file in files for place in block_places(file)}
    return set()


class Cluster:
    """A Dask scheduler and some workers of this machine, each of which may be killed and restarted.

    Their files are in a folder; `environment` is that of the workers.
    """

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


class CommandSweep:
    """A sweep by the command line, over masses and speeds."""

    def __init__(self, folder: Path, blocks: int):
        masses, speeds = np.linspace(0.1, 0.9, 64), np.linspace(1.5, 4.0, 4 * blocks)
        self.over = {"loads.0.mass": masses, "loads.0.speed": speeds}
        self._case = folder / "case.toml"
        self._case.write_text(tomli_w.dumps(case_to_dict(CASE)))

    def begin(self, store: Path, address: str | None) -> subprocess.Popen:
        """Begin or resume the sweep, on a cluster if there is an address."""
        lists = (f"{name}={','.join(map(repr, v.tolist()))}" for name, v in self.over.items())
        options = [part for one in lists for part in ("--over", one)]
        options += [] if address is None else ["--scheduler", address]
        command = [sys.executable, "-m", "jaxbeam", "sweep", str(self._case), *options]
        return subprocess.Popen(
            [*command, "-o", str(store), "--resume", "--json"],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )


def run(
    seed: int, workers: int, sweep: CommandSweep, expected: dict[str, bytes], folder: Path
) -> KilledSweep:
    """Kill processes of a sweep at random until it has survived, then let it end."""
    draws, store = random.Random(seed), folder / "runs.zarr"
    environment = {
        "KILLED_SWEEPS_SLOW": str(draws.choice([0.1, 0.3])),
        "KILLED_SWEEPS_FULL": str(draws.choice([0.0, 0.02])),
        "KILLED_SWEEPS_CLOCK": str(draws.choice([-7200, 3600])),
    }
    outcome, cluster = KilledSweep(Counter(), Counter(), []), Cluster(folder, workers, environment)
    begun, limit = time.monotonic(), 10 * LONGEST
    try:
        while True:
            client, before = sweep.begin(store, cluster.start()), finished(store)
            kills = KILLS - outcome.killed.total()
            victims = draws.sample(
                ["worker"] * workers + ["scheduler", "client"],
                k=min(kills, draws.choice([1, 2, 3])),
            )
            _kill_later(draws, victims, cluster, client, store, outcome)
            said = _wait(client, store, outcome)
            if not before <= finished(store) and (store / "blocks").exists():
                outcome.faults.append("a finished block is gone")
            if client.returncode == 0:
                break
            if client.returncode > 0:
                outcome.said[_one_sentence(said, outcome.faults)] += 1
            if time.monotonic() > begun + limit:
                outcome.faults.append(f"the sweep has not ended after {limit:.0f} s")
                return outcome
    finally:
        cluster.close()
    if files_of(store) != expected:
        outcome.faults.append("the store differs from that of one machine")
    left = [entry.name for entry in folder.iterdir() if entry.name.startswith(".runs")]
    if left:
        outcome.faults.append(f"left beside the store: {', '.join(left)}")
    return outcome


def _wait(client: subprocess.Popen, store: Path, outcome: KilledSweep) -> str:
    """Output of a client after its end; it is killed if no block is finished for LONGEST."""
    done, last = finished(store), time.monotonic()
    while True:
        try:
            return client.communicate(timeout=5.0)[0]
        except subprocess.TimeoutExpired:
            now = finished(store)
            if now != done:
                done, last = now, time.monotonic()
            if time.monotonic() > last + LONGEST:
                outcome.faults.append(f"a client did not end after {dict(outcome.killed)}")
                kill(client)


def _kill_later(
    draws, victims, cluster: Cluster, client, store: Path, outcome: KilledSweep
) -> None:
    """Kill some processes at random times once the client has begun to write blocks, if it does."""
    start = len(finished(store))
    while victims and client.poll() is None and len(finished(store)) <= start:
        time.sleep(0.01)
        if draws.random() < 0.0001:  # before any block
            break
    for victim in victims:
        time.sleep(draws.expovariate(1 / 0.7))
        if client.poll() is not None:
            return
        alive = [one for one in cluster.workers if one is not None and one.poll() is None]
        if victim == "worker" and not alive:
            continue
        process = {"scheduler": cluster.scheduler, "client": client}.get(victim)
        kill(process or draws.choice(alive))
        outcome.killed[victim] += 1
    if client.poll() is None and draws.random() < 0.7:  # someone starts them again
        cluster.start()


def _one_sentence(said: str, faults: list[str]) -> str:
    """Last line of a client; anything but one sentence of its own, after Dask's log, is a fault."""
    lines = [line for line in said.splitlines() if line.strip()]
    if not lines or not lines[-1].startswith("jaxbeam: "):
        faults.append(f"a client ended with: {said[-2000:]}")
    return lines[-1] if lines else ""


def main() -> int:
    """Run the sweeps of some seeds; return 1 if a law does not hold, else 0.

    Raises RuntimeError if the first sweep, of which no process is killed, does not end.
    """
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("seeds", type=int, nargs="*", default=[0])
    options.add_argument("--workers", type=int, default=4)
    options.add_argument("--blocks", type=int, default=40)
    arguments = options.parse_args()
    faults = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sweep, alone = CommandSweep(folder, arguments.blocks), folder / "alone.zarr"
        said, _ = (client := sweep.begin(alone, None)).communicate()
        if client.returncode:
            raise RuntimeError(said)
        expected = files_of(alone)
        print_table(("seed", "killed", "said", "faults"), right_from=4)
        for seed in arguments.seeds:
            own = folder / str(seed)
            own.mkdir()
            outcome = run(seed, arguments.workers, sweep, expected, own)
            faults += [f"seed {seed}: {fault}" for fault in outcome.faults]
            killed, said = (
                "; ".join(f"{count} x {name}" for name, count in part.items()) or "-"
                for part in (outcome.killed, outcome.said)
            )
            print_row((str(seed), killed, said, str(len(outcome.faults))))
    print("\n".join(faults))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())

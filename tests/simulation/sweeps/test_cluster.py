"""Sweeps on clusters and on several devices: the same store, and the same results to rounding."""

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
import tomli_w
from numpy.testing import assert_allclose

import jaxbeam as jb
from experiments.benchmarks.common import without_native
from jaxbeam.cli import main
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.simulation.sweeps import blocks, cluster, integration
from jaxbeam.simulation.sweeps.specification import specification_from_dict, sweep_specification
from jaxbeam.simulation.sweeps.store import ZarrStore, create_store
from tests.simulation.sweeps.test_store import files_of
from tests.simulation.sweeps.test_sweep import CASE, blocks_written

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")

OVER = {"loads.0.mass": np.linspace(0.1, 0.9, 64), "loads.0.speed": np.linspace(1, 4, 48)}


@pytest.fixture(scope="module")
def workers():
    """Client of two workers in processes of their own."""
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0"
        ) as machines,
        distributed.Client(machines, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def local_store(tmp_path_factory):
    """Store of the sweep, made on one machine."""
    path = tmp_path_factory.mktemp("alone") / "runs.zarr"
    jb.sweep(CASE, OVER, store=path, progress=False)
    return path


def kill_one(client, store: Path) -> None:
    """Kill a worker as soon as three blocks are done."""
    while len(blocks_written(store)) < 3:
        time.sleep(0.001)
    os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)


@pytest.mark.filterwarnings("default")  # of Dask, about the worker that is killed
def test_killed_worker_does_not_change_the_store(workers, local_store, tmp_path):
    store = tmp_path / "runs.zarr"
    killer = threading.Thread(target=kill_one, args=(workers, store))
    killer.start()
    found = jb.sweep(CASE, OVER, store=store, progress=False, client=workers)
    killer.join()
    assert not found.failed.any()
    assert files_of(store) == files_of(local_store)

    # Started and killed on one machine, finished by the workers.
    second = tmp_path / "second.zarr"

    def stop(self, block, results):
        if block == 2:
            raise KeyboardInterrupt
        write(self, block, results)

    write = ZarrStore.write
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ZarrStore, "write", stop)
        with pytest.raises(KeyboardInterrupt):
            jb.sweep(CASE, OVER, store=second, progress=False)
    case = tmp_path / "case.toml"
    case.write_text(tomli_w.dumps(case_to_dict(CASE)))
    lists = [f"{name}={','.join(map(repr, values.tolist()))}" for name, values in OVER.items()]
    address = workers.scheduler.address
    line = ["sweep", str(case), "--scheduler", address, "-o", str(second), "--resume", "--json"]
    with pytest.raises(SystemExit) as ended:
        main([*line, "--over", lists[0], "--over", lists[1]])
    assert ended.value.code == 0
    assert files_of(second) == files_of(local_store)
    assert case.read_text() == tomli_w.dumps(tomllib.loads(case.read_text()))


def test_specification_from_its_dictionary_is_equal():
    specification = sweep_specification(CASE, OVER, False, False, 1e-7, "double")
    restored = specification_from_dict(specification.to_dict())
    assert restored.fingerprint() == specification.fingerprint()
    np.testing.assert_array_equal(restored.runs(), specification.runs())


def test_workers_refuse_missing_stores_and_other_versions(tmp_path, monkeypatch):
    path = tmp_path / "runs.zarr"
    with pytest.raises(ValueError, match="where all machines see it"):
        cluster.compute_and_store([0], "fingerprint", path)
    content = sweep_specification(CASE, {"loads.0.mass": [0.1]}, False, False, 1e-7, "double")
    create_store(path, "fingerprint", content.to_dict(), np.ones(2))
    monkeypatch.setattr(cluster, "_runner", lambda fingerprint, store: (None, "other"))
    with pytest.raises(ValueError, match="another version of jaxbeam"):
        cluster.compute_and_store([0], "fingerprint", path)
    with pytest.raises(ValueError, match="write their blocks to a store; name one"):
        jb.sweep(CASE, {"loads.0.mass": [0.1]}, client=object())


def test_missing_scheduler_is_named():
    with pytest.raises(ConnectionError, match="no Dask scheduler answers at nowhere"):
        cluster.connect("nowhere://1")


BEGUN, GO_ON = threading.Event(), threading.Event()


def compute_nothing(blocks, fingerprint, path):
    """What a worker does that never ends."""
    BEGUN.set()
    GO_ON.wait(30)
    return blocks


@pytest.fixture
def stuck(monkeypatch, tmp_path):
    """A cluster of one worker, which ends no block, and the computation of two blocks."""
    BEGUN.clear()
    GO_ON.clear()
    monkeypatch.setattr(cluster, "compute_and_store", compute_nothing)
    monkeypatch.setattr(cluster, "LONELY", 0.3)
    monkeypatch.setattr(cluster, "CHECK", 0.05)
    with (
        # A worker tells its scheduler that it ends; one that is lost would be waited for 30 s.
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
        ) as machines,
        distributed.Client(machines, timeout="2s", set_as_default=False) as client,
    ):
        yield machines, lambda: list(cluster.compute_blocks(client, "f", tmp_path, [0, 1]))
        GO_ON.set()


@pytest.mark.filterwarnings("default")  # of Dask
@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ("workers", "has had no workers for 0 s; no block has finished"),
        ("scheduler", "the scheduler .* is lost"),
    ],
)
def test_lost_workers_and_schedulers_end_a_sweep_in_a_sentence(stuck, lost, message):
    """It had waited for ever for workers, and ended in Dask's own words without a scheduler."""
    machines, compute = stuck

    def lose():
        BEGUN.wait(30)
        if lost == "workers":
            machines.scale(0)
        else:
            machines.sync(machines.scheduler.close)

    thread = threading.Thread(target=lose)
    thread.start()
    with pytest.raises(RuntimeError, match=message):
        compute()
    thread.join()


@pytest.mark.filterwarnings("default")  # of Dask
def test_a_scheduler_that_is_lost_while_it_is_asked_ends_a_sweep_in_a_sentence(stuck, monkeypatch):
    """Its client had not noticed, and the sweep ended in an OSError; seen on one core."""
    machines, compute = stuck
    ask, answers = distributed.Client.nthreads, []

    def nthreads(client):
        answers.append(None)
        if len(answers) == 1:
            return ask(client)
        machines.sync(machines.scheduler.close)
        raise OSError("Timed out trying to connect")

    monkeypatch.setattr(distributed.Client, "nthreads", nthreads)
    with pytest.raises(RuntimeError, match="the scheduler .* is lost"):
        compute()
    assert len(answers) > 1


CROSSING = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=3),
    supports=[jb.Support(0.25, stiffness=2e4, damping=3.0)],  # modes coupled by a damper
    actuators=[jb.PointForce(0.3)],
    sensors=[jb.Sensor(0.15), jb.Sensor(0.4)],
    loads=[jb.MovingMass(mass=0.3, speed=1.0), jb.MovingForce(force=2.0, speed=2.0)],
    run=jb.Run(0.5, sample_rate=200.0),
)
OVER_SPEEDS = {
    "loads.0.mass": np.linspace(0.1, 1.0, 5),
    "loads.0.speed": np.geomspace(1.0, 10.0, 4),
    "beam.flexural_rigidity": [10.0, 12.0],
}


def test_single_precision_meets_its_error_estimate():
    double, single = (
        jb.sweep(CROSSING, OVER_SPEEDS, progress=False, precision=word)
        for word in ("double", "single")
    )
    assert single.peak_deflection.dtype == np.float32
    assert double.peak_deflection.dtype == np.float64
    error = np.max(np.abs(single.peak_deflection / double.peak_deflection - 1))
    assert 1e-8 < error < 2e-5  # some tens of roundings, 6e-8 each
    assert float(error) < 5 * single.error_estimate  # measured on a sample of the runs
    assert not single.failed.any()
    with_histories = jb.sweep(
        CROSSING, OVER_SPEEDS, progress=False, precision="single", histories=True
    )
    assert with_histories.deflection.dtype == np.float32
    assert_allclose(
        np.abs(with_histories.deflection).max("time") <= double.peak_deflection * 1.00002, True
    )


@pytest.mark.parametrize("option", ["double", "single", "histories"])
def test_batches_at_once_as_on_accelerators(monkeypatch, option):
    options = {"histories": True} if option == "histories" else {"precision": option}
    expected = jb.sweep(CROSSING, OVER_SPEEDS, progress=False, **options)
    for module in (blocks, integration):
        monkeypatch.setattr(module, "in_sequence", lambda: False)
    jax.clear_caches()
    with without_native():
        found = jb.sweep(CROSSING, OVER_SPEEDS, progress=False, **options)
    tolerance = 2e-5 if option == "single" else 1e-10
    assert_allclose(found.peak_deflection, expected.peak_deflection, rtol=tolerance)
    if option == "histories":
        assert_allclose(found.deflection, expected.deflection, rtol=1e-9, atol=1e-16)


def test_unknown_precisions_are_refused():
    with pytest.raises(ValueError, match="precision must be double or single, not 'half'"):
        jb.sweep(CROSSING, OVER_SPEEDS, precision="half")
    controlled = dataclasses.replace(CROSSING, controller=jb.Feedback(gains=[100.0], period=0.01))
    with pytest.raises(ValueError, match="controllers need double precision"):
        jb.sweep(controlled, OVER_SPEEDS, precision="single")


SHARED = """
import sys
import jax
import numpy as np
import jaxbeam as jb
from tests.simulation.sweeps.test_cluster import CROSSING, OVER_SPEEDS
assert len(jax.local_devices()) == 3
peaks = jb.sweep(CROSSING, OVER_SPEEDS, progress=False).peak_deflection.values
lines = jb.sweep(CROSSING, OVER_SPEEDS, progress=False, histories=True).deflection.values
np.savez(sys.argv[1], peaks=peaks, lines=lines)
"""


def test_several_devices_share_a_block(tmp_path):
    """Three devices and eight batches, which three does not divide."""
    flags = os.environ["XLA_FLAGS"] + " --xla_force_host_platform_device_count=3"
    command = [sys.executable, "-c", SHARED, str(tmp_path / "shared.npz")]
    subprocess.run(
        command, env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}, check=True
    )
    one_device = jb.sweep(CROSSING, OVER_SPEEDS, progress=False, histories=True)
    with np.load(tmp_path / "shared.npz") as shared:
        assert_allclose(shared["lines"], one_device.deflection, rtol=1e-9, atol=1e-16)
        assert_allclose(
            shared["peaks"],
            jb.sweep(CROSSING, OVER_SPEEDS, progress=False).peak_deflection,
            rtol=1e-12,
        )

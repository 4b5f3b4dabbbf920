"""Blocks of sweeps are sized by memory: what they take, and the same results whatever they take.

Memory that is free, and the part of it that blocks take.
"""

import dataclasses
import errno
import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.runtime import memory
from jaxbeam.runtime.memory import block_memory, free_memory, size_text
from jaxbeam.simulation.sweeps import computation
from jaxbeam.simulation.sweeps.blocks import SensorGroups
from jaxbeam.simulation.sweeps.force_runner import FORCE_BLOCK_RUNS, LEAST_BYTES, PHASE
from jaxbeam.simulation.sweeps.specification import sweep_specification
from jaxbeam.simulation.sweeps.store import create_store, read_dataset

TRAIN = jb.Axles(speed=50.0, offsets=np.arange(10) * 3.0, forces=[1e5] * 10)
HEAVY = dataclasses.replace(TRAIN, masses=[100.0] * 10)
UNIFORM = jb.Beam(25.0, 3e10, 15000.0, 0.01, modes=4)
TAPERED = jb.Beam(
    25.0,
    damping_ratio=0.01,
    modes=4,
    segments=[jb.Segment(8.0, [6e10, -3e10], 15e3), jb.Segment(17.0, [3e10, 3e10], 15e3)],
)
SPEEDS = {"loads.0.speed": np.linspace(30.0, 80.0, 12)}


def case_of(beam, load, quantity, count):
    sensors = [jb.Sensor(x, quantity) for x in np.linspace(1.0, 24.0, count)]
    return jb.Case(beam, sensors=sensors, loads=[load], run=jb.Run(3.0, sample_rate=20.0))


def plan_of(case, memory, histories=False):
    return sweep_specification(case, SPEEDS, False, histories, 1e-7, "double", memory)


MANY_MODES = dataclasses.replace(UNIFORM, modes=20)


@pytest.mark.parametrize(
    ("beam", "quantity", "count", "duration"),
    [
        (UNIFORM, "moment", 30, 3.0),
        (TAPERED, "moment", 30, 3.0),
        (UNIFORM, "deflection", 40, 3.0),
        (TAPERED, "deflection", 40, 3.0),
        (MANY_MODES, "deflection", 3, 30.0),  # vibrates freely in most of its steps
    ],
    ids=["moment-30-uniform", "moment-30-tapered"]
    + ["deflection-40-uniform", "deflection-40-tapered", "free vibration"],
)
def test_forces_take_no_more_memory_than_counted(beam, quantity, count, duration):
    case = case_of(beam, TRAIN, quantity, count)
    case = dataclasses.replace(case, run=jb.Run(duration))
    large, small = (plan_of(case, memory).runner(False) for memory in ("8 GB", "1 kB"))
    assert large.block_runs == 12 <= FORCE_BLOCK_RUNS and small.block_runs == 1
    runs = np.arange(12)
    tracemalloc.start()
    found = large._peaks(runs, PHASE)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0.1 * 12 * large.run_bytes < most < 12 * large.run_bytes + LEAST_BYTES
    assert_allclose(small._peaks(runs, PHASE).peak_deflection, found.peak_deflection, rtol=1e-12)


@pytest.mark.usefixtures("c_integrator")
def test_sensors_in_groups_have_the_same_peaks():
    case = dataclasses.replace(
        case_of(UNIFORM, jb.MovingMass(mass=2e3, speed=50.0), "moment", 1),
        sensors=[jb.Sensor(20.0, "moment"), jb.Sensor(12.0), jb.Sensor(3.0, "shear")],
    )
    whole, parted = (plan_of(case, memory) for memory in ("8 GB", "1 kB"))
    assert whole.sensor_groups == [[1, 2, 0]] and parted.sensor_groups == [[1], [2], [0]]
    runner = parted.runner(native=True)
    assert isinstance(runner, SensorGroups)
    steps, error = runner.choose_step_sizes()
    assert error <= 1e-7
    found = [runner.block_function(steps)(block) for block in range(runner.block_count)]
    expected = whole.runner(native=True)
    compute = expected.block_function(expected.choose_step_sizes()[0])
    wanted = [compute(block) for block in range(expected.block_count)]
    # Of contact forces the smallest of samples counts, which other steps place elsewhere.
    for name, allowed in (("peak_deflection", 3e-7), ("lowest_contact_force", 1e-5)):
        one, other = (np.concatenate([b[name] for b in part])[:12] for part in (found, wanted))
        assert_allclose(one, other, rtol=allowed, err_msg=name)


def test_the_number_of_runs_falls_with_memory():
    """A beam with many corrected sensors under many heavy wheels, and one with long histories."""
    many = case_of(UNIFORM, HEAVY, "moment", 161)
    batches = {}
    for size in ("64 GB", "2 GB"):
        plan = plan_of(many, size)
        assert plan._sizes.batch_bytes(many.sensors[:1], 1) < plan.block_bytes
        sensors = [many.sensors[i] for i in plan.sensor_groups[0]]
        batches[size] = len(plan.sensor_groups), plan._sizes.batch_bytes(sensors, 1)
        assert batches[size][1] <= plan.block_bytes
    assert batches["64 GB"][0] < batches["2 GB"][0]
    long = dataclasses.replace(
        case_of(UNIFORM, jb.MovingMass(mass=100.0, speed=50.0), "deflection", 3),
        run=jb.Run(100.0, sample_rate=500.0),
    )
    masses = {"loads.0.mass": np.linspace(1.0, 2.0, 200)}
    given = long, masses, False, True, 1e-7, "double"
    runs = [
        sweep_specification(*given, memory).batches.run_index.shape[1]
        for memory in ("256 GB", "1 GB")
    ]
    assert runs[0] == 200 > 4 * runs[1]


def test_a_store_is_continued_with_the_blocks_of_its_beginning(tmp_path, monkeypatch):
    case = case_of(UNIFORM, TRAIN, "moment", 3)
    whole = jb.sweep(case, SPEEDS, store=tmp_path / "whole.zarr", progress=False, memory="1 kB")
    begun = computation._compute

    def interrupted(*given):
        for i, block in enumerate(begun(*given)):
            yield block
            if i == 3:
                raise KeyboardInterrupt

    monkeypatch.setattr(computation, "_compute", interrupted)
    path = tmp_path / "part.zarr"
    with pytest.raises(KeyboardInterrupt):
        jb.sweep(case, SPEEDS, store=path, progress=False, memory="1 kB")
    monkeypatch.undo()
    found = jb.sweep(case, SPEEDS, store=path, resume=True, progress=False, memory="8 GB")
    assert_array_equal(found.peak_moment, whole.peak_moment)


def test_the_progress_line_says_how_many_runs_a_block_has(capsys):
    case = case_of(UNIFORM, TRAIN, "moment", 1)
    jb.sweep(case, SPEEDS, memory="1 GB")
    assert "blocks of 12, each within " in capsys.readouterr().err


STANDING = {
    "force": jb.VaryingForce(force=1e5, position=10.0),
    "line load": jb.LineLoad(force_per_length=1000.0, lengths=[25.0], position=25.0),
}


@pytest.mark.parametrize("name", STANDING)
def test_sweeps_of_loads_that_stand_are_sized(name):
    """They have no speed. Peaks by the closed form of modes under a constant force."""
    case = case_of(UNIFORM, STANDING[name], "deflection", 1)
    case = dataclasses.replace(case, sensors=(jb.Sensor(10.0),), run=jb.Run(1.0))
    found = jb.sweep(case, {"beam.damping_ratio": [0.01, 0.05]}, progress=False)
    n = np.arange(1, 5) * np.pi / 25.0
    of_force = 1e5 * np.sin(10.0 * n)
    points = 0.25 * (np.arange(100) + 0.5)  # m: a line load is forces at the middles of its parts
    of_line = 1000.0 * 0.25 * np.sum(np.sin(np.outer(n, points)), axis=1)
    forces = 2 / (25.0 * 15000.0) * {"force": of_force, "line load": of_line}[name]
    omega = n**2 * np.sqrt(3e10 / 15000.0)
    t = np.linspace(0.0, 1.0, 20_001)
    for ratio, peak in zip((0.01, 0.05), found.peak_deflection.values[:, 0], strict=True):
        pole = omega * (-ratio + 1j * np.sqrt(1 - ratio**2))
        decay = np.real(np.exp(np.outer(t, pole)) * (1 - 1j * ratio / np.sqrt(1 - ratio**2)))
        history = (1 - decay) @ (np.sin(10.0 * n) * forces / omega**2)
        assert_allclose(peak, np.max(np.abs(history)), rtol=1e-6)


def test_collecting_takes_less_memory_than_all_blocks(tmp_path):
    """80 MB in blocks of 1 MB, of runs in any order; the last block repeats its last run."""
    order = np.random.default_rng(1).permutation(159)
    index = np.concatenate([order, [-1]]).reshape(-1, 2)[:, [1, 0]]
    store = create_store(tmp_path / "runs.zarr", "a" * 64, {}, np.ones(1))
    for block, rows in enumerate(index):
        values = np.maximum(rows, 0)[None, :, None, None] + np.linspace(0.0, 0.5, 64_000)[:, None]
        store.write(block, {"deflection": values})
    tracemalloc.start()
    flat = store.collect(80, index)["deflection"]
    variables = {"deflection": (("run", "time", "sensor"), flat, {})}
    store.finish(xarray.Dataset(variables, attrs={"jaxbeam_sweep": "a" * 64}))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    found = read_dataset(tmp_path / "runs.zarr").deflection
    assert most < 0.6 * 80e6 < found.nbytes  # zarr compresses some chunks at once
    assert_array_equal(found[:, -1, 0], np.arange(159) + 0.5)


@pytest.mark.parametrize("seeds", [{}, {"loads.0.seed": [1, 2]}], ids=["numbers", "seeds"])
def test_stored_histories_are_those_in_memory(tmp_path, seeds):
    load = jb.Crowd(speed=5.0, pace=2.0, people=2, length=5.0) if seeds else TRAIN
    case = case_of(UNIFORM, load, "deflection", 2)
    options = {"over": seeds | SPEEDS, "histories": True, "progress": False}
    found = jb.sweep(case, store=tmp_path / "runs.zarr", **options)
    xarray.testing.assert_equal(found, jb.sweep(case, **options))


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="space cannot be reserved here")
def test_collecting_onto_a_full_disk_keeps_the_blocks(tmp_path, monkeypatch):
    store = create_store(tmp_path / "runs.zarr", "a" * 64, {}, np.ones(1))
    store.write(0, {"deflection": np.ones((1, 2, 5, 1))})

    def full(*given):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="finished blocks are kept: mend this, then resume"):
        store.collect(1, np.array([[0, 1]]))


@pytest.mark.parametrize(
    ("given", "size"), [("2 GB", 2e9), ("512MiB", 2.0**29), (3e8, 3e8), ("1e9", 1e9)]
)
def test_memory_as_given(given, size):
    assert block_memory(given) == size


@pytest.mark.parametrize("given", ["2 apples", "-1", 0, "1e999", True, [1]])
def test_no_memory(given):
    with pytest.raises(ValueError, match="a number of bytes or a text as '2 GB'"):
        block_memory(given)


def test_a_quarter_of_what_is_free_by_default():
    assert block_memory() == pytest.approx(free_memory() / 4, rel=0.2)
    assert size_text(1.53e9) == "1.53 GB" and size_text(2e4) == "20 kB"


def test_containers_limit_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "GROUPS", tmp_path)
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("700000\n")
    (tmp_path / "memory.stat").write_text("anon 500000\ninactive_file 200000\n")
    assert free_memory() == 500_000
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory() > 1e7


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_limits_of_the_process():
    program = (
        "import resource, jaxbeam.runtime.memory as m;"
        "resource.setrlimit(resource.RLIMIT_AS, (8 * 2**30, 8 * 2**30));"
        "a = m.free_memory(); b = bytearray(2**27); print(a, a - m.free_memory())"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    free, taken = map(float, found.stdout.split())
    assert free < 8 * 2**30 and taken > 2**26

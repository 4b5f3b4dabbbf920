"""The C integrator: peaks equal to those of XLA, for all kinds of models, outputs and paths."""

import ctypes
import dataclasses
import json
import os
import pathlib
import platform
import re
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.cli import main
from jaxbeam.numerics import polynomials
from jaxbeam.numerics.polynomials import interpolation_matrix, refine_peak
from jaxbeam.runtime import native_library
from jaxbeam.simulation.integrator import discrete_model, native_peaks, peaks, step_matrices
from jaxbeam.simulation.integrator.discrete_model import PEAK_NODES
from jaxbeam.simulation.sweeps import blocks
from jaxbeam.simulation.sweeps.specification import sweep_specification
from jaxbeam.simulation.sweeps.store import ZarrStore

pytestmark = pytest.mark.skipif(native_library.find_compiler() is None, reason="no C compiler here")

ROOT = pathlib.Path(__file__).parents[3]
BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=3)
SENSORS = [jb.Sensor(0.15), jb.Sensor(0.3), jb.Sensor(0.41)]
PLAIN = jb.Case(BEAM, sensors=SENSORS, loads=[jb.MovingMass(mass=0.5, speed=1.0)], run=jb.Run(1.0))
# One block of states, some of them of an actuator; a patch and a damper couple all modes.
COUPLED = jb.Case(
    BEAM,
    supports=[jb.Support(0.25), jb.Support(0.5, stiffness=2e4, damping=30.0)],
    actuators=[
        jb.Electrodynamic(0.1, resistance=4.0, inductance=1e-3, force_constant=5.0, mass=0.02),
        jb.Patch(0.3, 0.4, moment_per_volt=1e-4, added_mass=0.01, added_rigidity=0.5),
    ],
    sensors=SENSORS[:2],
    loads=[jb.MovingMass(mass=0.5, speed=1.0)],
    run=jb.Run(1.0),
)
# Three loads, two of them on the beam at once, one decelerating, one in the other direction.
STREAM = jb.Case(
    BEAM,
    sensors=SENSORS[:1],
    loads=[
        jb.MovingMass(mass=0.5, speed=2.0, deceleration=2.0),
        jb.MovingForce(force=3.0, speed=-1.5, entry_time=0.1),
        jb.MovingMass(mass=0.2, speed=1.0, entry_time=0.6),
    ],
    run=jb.Run(1.5),
)
# A heavy mass at high speed: contact is lost, and some runs diverge.
# Damped a little: free vibration of a pinned beam would repeat its peak, and rounding choose one.
LOST_CONTACT = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, modes=6, damping_ratio=1e-3),
    sensors=SENSORS,
    loads=[jb.MovingMass(mass=5.0, speed=20.0)],
    run=jb.Run(0.2),
)
# Several spans; a load that reverses on the beam, and one that starts from rest on it.
LONG = jb.Case(
    jb.Beam(3.0, 900.0, 2.0, damping_ratio=0.01, modes=7, ends="clamped-pinned"),
    supports=[jb.Support(1.0), jb.Support(2.2)],
    sensors=[jb.Sensor(0.5), jb.Sensor(1.7), jb.Sensor(2.9)],
    loads=[
        jb.MovingMass(mass=1.0, times=[0.0, 0.5, 1.0, 1.6], positions=[-0.1, 1.4, 0.9, 0.2]),
        jb.MovingForce(mass=2.0, times=[0.0, 0.7, 1.5], positions=[1.5, 1.5, 3.2]),
        jb.MovingMass(mass=0.3, speed=-2.0, entry_time=0.2, deceleration=-1.0),
    ],
    run=jb.Run(2.0),
)
# Masses on a rough road and forces that vary, whose moments follow the contact forces at once.
ROUGH = dataclasses.replace(
    PLAIN,
    sensors=[jb.Sensor(0.3), jb.Sensor(0.2, "moment"), jb.Sensor(0.4, "shear")],
    loads=[
        jb.MovingMass(mass=0.5, speed=1.0),
        jb.MovingMass(mass=0.2, speed=-1.5),
        jb.VaryingForce(force_times=[0.1, 0.3], forces=[1.0, 4.0], speed=0.8),
    ],
    profile=jb.profiles.SineProfile(amplitude=2e-4, wavelength=0.15),
)
# Other quantities, on a beam whose modes are coupled by a damper.
QUANTITIES = ("velocity", "acceleration", "strain", "moment", "shear")
MEASURED = dataclasses.replace(
    PLAIN,
    supports=[jb.Support(0.45, stiffness=2e4, damping=30.0)],
    sensors=[
        jb.Sensor(0.2, name, fibre_distance=2e-3 if name == "strain" else None)
        for name in QUANTITIES
    ],
    run=jb.Run(0.7),
)
CONTROLLED = dataclasses.replace(
    PLAIN,
    actuators=[jb.Patch(0.1, 0.2, moment_per_volt=1e-4)],
    controller=jb.PD(gains=[300.0], rate_gains=[3.0], lag=[0.002], period=0.004),
    sensors=SENSORS[:1],
)
FEW = {"loads.0.mass": [0.1, 0.5], "loads.2.speed": [0.8, 1.2]}
GRID = {"loads.0.mass": np.linspace(0.05, 1.0, 13), "loads.0.speed": [1.0, 2.0, 7.0]}


@pytest.fixture(scope="module", autouse=True)
def folder(native_cache):
    """The C integrator, compiled into a cache folder of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", native_cache)
        assert native_peaks.available()
        yield native_peaks.LIBRARY.library_path().parent


def sweep_by_c_and_xla(case, over):
    """Results of a sweep with the C integrator, and without."""
    native = jb.sweep(case, over, progress=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_peaks, "available", lambda: False)
        patch.setattr(blocks, "suits_numpy", lambda *_: False)
        return native, jb.sweep(case, over, progress=False)


@pytest.mark.parametrize(
    ("case", "over"),
    [
        pytest.param(PLAIN, GRID, id="plain"),
        pytest.param(COUPLED, GRID | {"beam.flexural_rigidity": [9.0, 12.0]}, id="coupled"),
        pytest.param(
            PLAIN, {"loads.0.mass": [0.1, 0.5], "beam.flexural_rigidity": [9.0]}, id="one model"
        ),
        pytest.param(STREAM, FEW, id="stream"),
        pytest.param(LONG, {"loads.0.mass": [0.5, 2.0], "sensors.1.position": [1.8]}, id="long"),
        pytest.param(LOST_CONTACT, {"loads.0.mass": [0.5, 5.0, 60.0]}, id="lost contact"),
    ],
)
def test_results_equal_those_of_xla(case, over):
    native, plain = sweep_by_c_and_xla(case, over)
    assert_allclose(native.peak_deflection, plain.peak_deflection, rtol=1e-11)
    assert_allclose(native.lowest_contact_force, plain.lowest_contact_force, rtol=1e-9, atol=1e-9)
    assert_allclose(native.contact_lost_time, plain.contact_lost_time, rtol=1e-9)
    assert (native.failed == plain.failed).all()
    # The time of a peak is accurate to the square root of its height's accuracy.
    assert_allclose(native.peak_time, plain.peak_time, atol=2e-7)
    # They differ by rounding, or the sweep did not use C.
    assert np.any(native.peak_deflection != plain.peak_deflection)


@pytest.mark.parametrize("over", [{"loads.0.mass": [0.1, 0.5]}, {"profile.amplitude": [1e-4]}])
def test_peaks_on_rough_roads_equal_those_of_single_runs(over):
    assert native_peaks.supports(ROUGH)
    found = jb.sweep(ROUGH, over, tolerance=1e-8, progress=False)
    ((address, values),) = over.items()
    for i, value in enumerate(values):
        record = jb.simulate(jb.replace(ROUGH, {address: value}), tolerance=1e-9)
        largest = np.maximum(np.abs(record.smallest), record.largest)
        for n, quantity in enumerate(["deflection", "moment", "shear"]):
            assert_allclose(found[f"peak_{quantity}"][i, n], largest[n], rtol=2e-8)


def test_peaks_of_every_quantity_equal_those_of_a_single_run():
    found = jb.sweep(MEASURED, {"loads.0.mass": [0.5]}, tolerance=1e-8, progress=False)
    record = jb.simulate(MEASURED, tolerance=1e-9)
    largest = np.maximum(np.abs(record.smallest), record.largest)
    for i, name in enumerate(QUANTITIES):
        assert_allclose(found[f"peak_{name}"][0, i], largest[i], rtol=2e-8, err_msg=name)


def test_a_beam_without_loads_stays_at_rest():
    case = dataclasses.replace(PLAIN, loads=[])
    results = jb.sweep(case, {"beam.flexural_rigidity": [9.0, 12.0]}, progress=False)
    assert np.all(results.peak_deflection == 0) and not results.failed.any()


FILLED_SCRIPT = """
import jaxbeam as jb
from jaxbeam.simulation.integrator import native_peaks
from tests.simulation.integrator.test_native_peaks import COILED
native_peaks.MIN_RUNS_OF_LOOPS = 1
runs = jb.sweep(COILED, {"loads.0.speed": [0.8, 1.2]}, progress=False)
print(runs.lowest_contact_force.values.tobytes().hex(), runs.peak_deflection.values.tobytes().hex())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="its allocator fills memory")
def test_results_do_not_depend_on_what_memory_held():
    """A sample falls on the exit of the vehicle, but for rounding."""
    found = [
        subprocess.run(
            [sys.executable, "-c", FILLED_SCRIPT],
            env=os.environ | {"MALLOC_PERTURB_": filled, "PYTHONPATH": str(ROOT)},
            cwd=ROOT,
            capture_output=True,
            check=True,
        ).stdout
        for filled in ("0", "170")
    ]
    assert found[0] == found[1]


NARROW_SCRIPT = """
import sys
import jaxbeam as jb
from jaxbeam.simulation.integrator import native_peaks
from tests.simulation.integrator.test_native_peaks import COUPLED, GRID
native_peaks.LIBRARY.build()
assert native_peaks.available()
jb.sweep(COUPLED, GRID, progress=False).to_netcdf(sys.argv[1], engine="h5netcdf")
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="flags of compilers for x86")
@pytest.mark.parametrize("without", ["avx512f", "avx"])
def test_narrower_registers_give_equal_results(without, tmp_path, monkeypatch):
    """In another process: a process loads only one library."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", f"{native_library.find_compiler()} -mno-{without}")
    path = tmp_path / "found.nc"
    subprocess.run([sys.executable, "-c", NARROW_SCRIPT, str(path)], check=True, cwd=ROOT)
    monkeypatch.setattr(native_peaks, "available", lambda: False)
    plain = jb.sweep(COUPLED, GRID, progress=False).peak_deflection
    with xarray.open_dataset(path, engine="h5netcdf") as found:
        assert_allclose(found.peak_deflection, plain, rtol=1e-11)
        assert np.any(found.peak_deflection != plain)


def test_contact_is_lost_in_one_of_the_cases():
    contact_lost_time = jb.sweep(
        LOST_CONTACT, {"loads.0.mass": [0.5, 5.0]}, progress=False
    ).contact_lost_time
    assert np.isfinite(contact_lost_time).any()


def test_arguments_are_those_of_the_c_code():
    """In the same order, the mask before and constants after them."""
    text = (native_library.C_FOLDER / "workspace.h").read_text()
    names = re.search(r"enum \{\n    MASK,\n(.*?),\n    GAUSS_NODES", text, re.DOTALL).group(1)
    assert tuple(names.lower().replace(" ", "").split(",\n")) == native_peaks.NativeInputs._fields


def test_constants_are_those_of_the_c_code():
    spacing = np.diff(PEAK_NODES)
    margin = (peaks.PEAK_MARGIN - 1) * (spacing[0] / spacing.max()) ** 2  # beside an end
    expected = {
        "PADDING": 8,  # doubles in the widest vector register
        "CHUNK_STEPS": step_matrices.CHUNK_STEPS,
        "NODES": discrete_model.NODE_COUNT,
        "TAYLOR_TERMS": discrete_model.TAYLOR_TERMS,
        "DOUBLINGS": discrete_model.DOUBLINGS,
        "PEAK_POINTS": len(PEAK_NODES),
        "FORCE_POINTS": len(peaks.FORCE_FRACTIONS),
        "FORCE_GAP": peaks.FORCE_GAP,
        "ZERO_ITERATIONS": peaks.ZERO_ITERATIONS,
        "SPREAD_FACTOR": peaks.spread_factor(),
        "PEAK_MARGIN": peaks.PEAK_MARGIN,
        "END_PEAK_MARGIN": margin,
        "NEWTON_STEP_LIMIT": polynomials.newton_step_limit(PEAK_NODES),
        "ESTIMATE_ITERATIONS": polynomials.ESTIMATE_ITERATIONS,
        "START_POINTS": polynomials.START_POINTS,
        "NEWTON_ITERATIONS": polynomials.NEWTON_ITERATIONS,
        "TIE_TOLERANCE": polynomials.TIE_ROUNDING_UNITS * sys.float_info.epsilon,
    }
    text = (native_library.C_FOLDER / "constants.h").read_text()
    found = {name: float(value) for name, value in re.findall(r"#define (\w+) (\S+)", text)}
    assert found == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("last", ["loads.0.speed", "beam.flexural_rigidity"])
def test_the_last_block_is_that_of_its_runs_alone(last):
    """With fewer batches than others; of models that differ, with masked tasks."""
    case = dataclasses.replace(PLAIN, run=jb.Run(0.4))
    over = {"loads.0.mass": [0.2, 0.9], last: np.linspace(7.0, 9.0, 1301)}
    native = jb.sweep(case, over, progress=False).peak_deflection
    alone = jb.sweep(case, over | {last: over[last][-3:]}, progress=False).peak_deflection
    assert_allclose(native[:, -3:], alone, rtol=1e-6)


def specification_of(case, histories=False, precision="double"):
    return sweep_specification(case, GRID, False, histories, 1e-7, precision)


def test_sweeps_in_double_precision_use_c():
    assert specification_of(PLAIN).uses_c()
    assert specification_of(PLAIN, histories=True).uses_c()
    assert not specification_of(PLAIN, precision="single").uses_c()
    assert specification_of(CONTROLLED).uses_c()
    continuous = dataclasses.replace(CONTROLLED.controller, period=None)
    assert not specification_of(dataclasses.replace(CONTROLLED, controller=continuous)).uses_c()
    moments = dataclasses.replace(PLAIN, sensors=[jb.Sensor(0.2, "moment")])
    assert specification_of(moments).uses_c()
    sheared = dataclasses.replace(BEAM, shear_stiffness=1e5)
    assert not specification_of(dataclasses.replace(moments, beam=sheared)).uses_c()


@pytest.mark.parametrize(
    ("case", "share", "mass"),
    [
        pytest.param(PLAIN, 1.0, 0.5, id="plain"),
        pytest.param(COUPLED, 0.4, 0.5, id="coupled, ends on the beam"),
        pytest.param(STREAM, 0.5, 0.5, id="stream"),
        pytest.param(ROUGH, 0.3, 0.5, id="rough"),
        pytest.param(MEASURED, 0.3, 0.5, id="measured"),
        pytest.param(LOST_CONTACT, 1.0, 60.0, id="lost contact"),
        pytest.param(CONTROLLED, 0.5, 0.5, id="controlled"),
    ],
)
def test_histories_equal_those_of_numpy(case, share, mass):
    run = jb.Run(share * float(case.run.duration), sample_rate=130.0)
    case, over = dataclasses.replace(case, run=run), {"loads.0.mass": [0.1, mass]}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_peaks, "MIN_RUNS_OF_LOOPS", 1)
        assert native_peaks.chosen_for(case, 2)
        first, choose = [], blocks.Runner.choose_step_sizes

        def chosen(runner):
            first[:] = first or [choose(runner)]
            return first[0]

        patch.setattr(blocks.Runner, "choose_step_sizes", chosen)
        native = jb.sweep(case, over, progress=False, histories=True)
        patch.setattr(native_peaks, "available", lambda: False)
        known = jb.sweep(case, over, progress=False, histories=True)
    compared = "deflection", f"peak_{case.sensors[0].quantity}", "lowest_contact_force"
    for name in compared:
        largest = float(np.nanmax(np.abs(known[name])))
        assert_allclose(native[name], known[name], rtol=0, atol=1e-10 * largest)


@pytest.mark.parametrize("begun_in_c", [True, False])
def test_a_sweep_continues_as_it_was_begun(begun_in_c, tmp_path, monkeypatch):
    """Both integrators round differently; a store has the results of one of them."""
    over = {"loads.0.mass": np.linspace(0.1, 0.9, 60), "loads.0.speed": [2.0, 4.0]}
    case, path = dataclasses.replace(PLAIN, run=jb.Run(0.4)), tmp_path / "runs.zarr"

    def sweep(available, store, **options):
        monkeypatch.setattr(native_peaks, "available", lambda: available)
        return jb.sweep(case, over, progress=False, store=store, **options)

    expected = sweep(begun_in_c, None)
    with monkeypatch.context() as patch:
        patch.setattr(ZarrStore, "finish", interrupted)
        with pytest.raises(KeyboardInterrupt):
            sweep(begun_in_c, path)
    if begun_in_c:
        with monkeypatch.context() as patch:
            patch.setattr(native_library, "find_compiler", lambda: None)
            with pytest.raises(ValueError, match="begun with steps in C, .*: there is no C comp"):
                sweep(False, path, resume=True)
    for file in path.glob("blocks/*/*.blocks"):
        file.unlink()
    found = sweep(not begun_in_c, path, resume=True)
    assert np.array_equal(found.peak_deflection, expected.peak_deflection)


def interrupted(*_):
    raise KeyboardInterrupt


def test_the_first_large_sweep_compiles_c(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    library, many = native_peaks.LIBRARY, native_peaks.MIN_RUNS_TO_COMPILE
    over = {"loads.0.mass": np.linspace(0.1, 0.9, many // 2), "loads.0.speed": [5.0, 7.0]}
    case = dataclasses.replace(PLAIN, run=jb.Run(0.2))
    assert not native_peaks.chosen_for(case, many - 1)
    assert native_peaks.chosen_for(case, many)
    with monkeypatch.context() as patch:
        patch.setenv("CC", "false")
        without = jb.sweep(case, over, progress=False)
    assert not library.library_path().exists()
    found = jb.sweep(case, over, progress=False)
    assert library.library_path().exists() and native_peaks.chosen_for(case, 1)
    assert_allclose(found.peak_deflection, without.peak_deflection, rtol=1e-11)
    assert np.any(found.peak_deflection != without.peak_deflection)
    library.remove()
    assert not native_peaks.chosen_for(case, many)


def test_the_command_compiles_and_removes(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(SystemExit, match="0"):
        main(["native", "--json"])
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"path": str(native_peaks.LIBRARY.library_path()), "compiled": True}
    assert native_peaks.LIBRARY.library_path().exists() and native_peaks.available()
    with pytest.raises(SystemExit, match="0"):
        main(["native", "--remove"])
    assert "sweeps use XLA" in capsys.readouterr().out
    assert not native_peaks.available()


SEARCH = """
#include "peak_search.h"
void search(const double *samples, const double *interpolation, double *heights, int curves) {
    for (int first = 0; first < curves; first += REGISTER_WIDTH) {
        const int count = curves - first < REGISTER_WIDTH ? curves - first : REGISTER_WIDTH;
        Register values[PEAK_POINTS];
        for (int p = 0; p < PEAK_POINTS; p++) values[p] = load(samples + p * curves + first, count);
        const Curve curve = curve_through(values, interpolation);
        store(heights + first, magnitude(&curve, find_peak(&curve)), count);
    }
}
"""


def test_peaks_of_curves_through_any_samples(tmp_path):
    """Many of these curves have several extrema within a step."""
    curves = np.random.default_rng(0).normal(size=(len(PEAK_NODES), 2, 5000))
    curves[:, 1] = np.cumsum(curves[:, 1], axis=0)  # smoother
    curves = curves.reshape(len(PEAK_NODES), -1)
    (tmp_path / "search.c").write_text(SEARCH)
    compiler, flags = native_library.find_compiler(), native_peaks.LIBRARY.compiler_flags
    include = ["-I", str(native_library.C_FOLDER)]
    sources = ["search.c", str(native_library.C_FOLDER / "matrices.c")]
    command = [compiler, "-shared", *flags, *include, *sources, "-o", "search.so"]
    subprocess.run(command, check=True, cwd=tmp_path)
    pointer = np.ctypeslib.ndpointer(float, flags="C")
    search = ctypes.CDLL(str(tmp_path / "search.so")).search
    search.argtypes = [pointer, pointer, pointer, ctypes.c_int]
    heights = np.empty(curves.shape[1])
    rows = interpolation_matrix(PEAK_NODES)[: len(PEAK_NODES)].T
    search(curves, np.ascontiguousarray(rows), heights, heights.size)
    assert_allclose(heights, refine_peak(jnp.asarray(curves), PEAK_NODES)[0], rtol=1e-11)


@pytest.mark.parametrize("quantity", ["moment", "shear", "deflection"])
def test_stated_errors_hold(quantity):
    """Peaks beside those of ten thousand times smaller tolerance, static corrections included."""
    case = jb.Case(
        jb.Beam(1.0, 1.0, 1.0, damping_ratio=0.01, modes=4),
        sensors=[jb.Sensor(0.43, quantity)],
        loads=[jb.MovingMass(mass=0.3, speed=0.3)],
        run=jb.Run(20.0, sample_rate=20.0),
    )
    over = {"loads.0.mass": [0.02, 0.2, 0.4], "loads.0.speed": np.geomspace(0.15, 2.5, 24)}
    found, exact = (
        jb.sweep(case, over, progress=False, tolerance=tolerance) for tolerance in (1e-7, 1e-11)
    )
    peaks, expected = (one[f"peak_{quantity}"] for one in (found, exact))
    assert found.error_estimate <= 1e-7
    assert_allclose(peaks, expected, rtol=found.error_estimate)


def test_stated_errors_hold_for_random_masses():
    """Each run a batch of its own: steps that suit light loads are too long for heavy ones."""
    case = jb.Case(
        jb.Beam(1.0, 1.0, 1.0, damping_ratio=0.01, modes=4),
        sensors=[jb.Sensor(0.43, name) for name in ("deflection", "acceleration", "moment")],
        loads=[jb.MovingMass(mass=0.3, speed=0.3), jb.MovingForce(force=1.0, speed=1.0)],
        run=jb.Run(3.0, sample_rate=20.0),
    )
    random = np.random.default_rng(1)
    over = {
        address: scale * np.exp(random.uniform(np.log(low), np.log(high), 64))
        for address, scale, low, high in (
            ("loads.0.mass", 1.0, 0.01, 100.0),
            ("loads.0.speed", np.pi, 0.05, 10.0),
            ("loads.1.speed", np.pi, 0.05, 10.0),
        )
    }
    found, exact = (
        jb.sweep(case, over, paired=True, progress=False, tolerance=tolerance)
        for tolerance in (1e-6, 1e-8)
    )
    for name in ("deflection", "acceleration", "moment"):
        assert_allclose(found[f"peak_{name}"], exact[f"peak_{name}"], rtol=found.error_estimate)


# Sampled loops. Modes that nothing couples, readings with noise that are late, limits of commands;
# and a vehicle on a profile, a coil with a state of its own, an analogue filter, another law.
PATCHED = dataclasses.replace(
    PLAIN,
    actuators=[jb.Patch(0.2575, 0.3425, moment_per_volt=1e-3, limits=(-5.0, 5.0))],
    sensors=[
        jb.Sensor(0.3, delay=0.002, noise=1e-6),
        jb.Sensor(0.15, "velocity", filter=jb.Filter(40.0), sampling_period=0.004),
    ],
    controller=jb.Feedback(gains=[2e4], period=0.01, delay=0.003, resolution=0.01),
)
COILED = dataclasses.replace(
    PLAIN,
    actuators=[
        jb.Electrodynamic(0.1, resistance=4.0, inductance=1e-3, force_constant=5.0, mass=0.02)
    ],
    sensors=[jb.Sensor(0.3), jb.Sensor(0.2, filter=jb.Filter(60.0, realisation="analogue"))],
    loads=[jb.QuarterCar(0.3, 0.1, 400.0, 4.0, 4e3, speed=1.0), jb.MovingForce(3.0, speed=2.0)],
    profile=jb.profiles.SineProfile(amplitude=2e-4, wavelength=0.15),
    controller=jb.LQR([1.0] * 7, [1.0], period=0.0025, estimator=jb.Kalman([0.02] * 3, [1e-5] * 2)),
)
UNSTABLE = dataclasses.replace(
    PATCHED,
    actuators=[jb.PointForce(0.3)],
    controller=jb.Feedback(gains=[-1e5], period=0.01),
)


@pytest.mark.parametrize(
    ("case", "over"),
    [
        pytest.param(PATCHED, {"loads.0.mass": [0.1, 0.5, 0.3], "loads.0.speed": [1.0, 2.0]}),
        pytest.param(COILED, {"loads.0.speed": [0.8, 1.2]}),
        pytest.param(PATCHED, {"controller.gains.0": [1e4, 2e4]}),
        pytest.param(UNSTABLE, {"loads.0.mass": [0.1, 0.5]}),
    ],
)
@pytest.mark.filterwarnings("ignore:all 2 runs failed")
def test_sampled_loops_equal_those_of_numpy(case, over, monkeypatch):
    """To rounding, which a loop multiplies at each of its samples."""
    monkeypatch.setattr(native_peaks, "MIN_RUNS_OF_LOOPS", 1)
    native = jb.sweep(case, over, progress=False)
    calls = []
    monkeypatch.setattr(native_peaks, "available", lambda: bool(calls.append(1)))
    plain = jb.sweep(case, over, progress=False)
    assert calls
    assert (native.failed == plain.failed).all()
    assert native.failed.all() == (case is UNSTABLE)
    if case is UNSTABLE:
        return
    assert (native.controller_failures == plain.controller_failures).all()
    for name in ("peak_deflection", "lowest_contact_force"):
        scale = float(abs(plain[name]).max())
        assert_allclose(native[name], plain[name], rtol=0, atol=1e-11 * scale)
    assert np.any(native.peak_deflection != plain.peak_deflection)  # it did use C

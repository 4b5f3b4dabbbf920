"""Steps by hand-written C: the same results as without, on every kind of rig and path."""

import ctypes
import dataclasses
import hashlib
import json
import pathlib
import platform
import re
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import replace
from jaxbeam.cli import main
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.integrate import integrate_peaks
from jaxbeam.integrator.propagators import PEAK_NODES
from jaxbeam.integrator.time_grid import grid_by_step_length
from jaxbeam.model.contact import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.numerics import peak_search
from jaxbeam.runtime import native_library
from jaxbeam.runtime.cache_folder import read_file, write_file
from jaxbeam.simulation.integration_plan import static_shapes
from jaxbeam.sweeps.specification import sweep_specification
from jaxbeam.sweeps.store import FINGERPRINT_ATTRIBUTE

pytestmark = pytest.mark.skipif(native_library.find_compiler() is None, reason="no C compiler here")

ROOT = pathlib.Path(__file__).parents[2]
BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=3)
SENSORS = [jb.Sensor(0.15), jb.Sensor(0.3), jb.Sensor(0.41)]
PLAIN = jb.Case(BEAM, sensors=SENSORS, loads=[jb.MovingMass(mass=0.5, speed=1.0)], run=jb.Run(1.0))
# One block of states, of which some are an actuator's own; a patch and a damper couple all modes.
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
# Three loads, two of them on the beam at once, one braking, one coming the other way.
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
# A heavy mass at high speed: it would have to pull, and not all of its runs stay finite.
WILD = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, modes=6, damping_ratio=0.0),
    sensors=SENSORS,
    loads=[jb.MovingMass(mass=5.0, speed=20.0)],
    run=jb.Run(0.2),
)
# Several spans; a path that turns round on the beam, and a load that stands until it goes.
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
FEW = {"loads.0.mass": [0.1, 0.5], "loads.2.speed": [0.8, 1.2]}
GRID = {"loads.0.mass": np.linspace(0.05, 1.0, 13), "loads.0.speed": [1.0, 2.0, 7.0]}


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory):
    """The C, compiled into a cache folder of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        assert not native_peaks.available()
        assert native_peaks.LIBRARY.build() == native_peaks.LIBRARY.library_path()
        assert native_peaks.available()
        yield native_peaks.LIBRARY.library_path().parent


def swept(case, over):
    with_it = jb.sweep(case, over, progress=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_peaks, "available", lambda: False)
        return with_it, jb.sweep(case, over, progress=False)


@pytest.mark.parametrize(
    ("case", "over"),
    [
        pytest.param(PLAIN, GRID, id="plain"),
        pytest.param(COUPLED, GRID | {"beam.flexural_rigidity": [9.0, 12.0]}, id="coupled"),
        pytest.param(STREAM, FEW, id="stream"),
        pytest.param(LONG, {"loads.0.mass": [0.5, 2.0], "sensors.1.position": [1.8]}, id="long"),
        pytest.param(WILD, {"loads.0.mass": [0.5, 5.0, 60.0]}, id="wild"),
    ],
)
def test_results_are_those_without_it(case, over):
    by_hand, plain = swept(case, over)
    assert_allclose(by_hand.peak_deflection, plain.peak_deflection, rtol=1e-11)
    assert_allclose(by_hand.lowest_contact_force, plain.lowest_contact_force, rtol=1e-9, atol=1e-9)
    assert_allclose(by_hand.contact_lost_time, plain.contact_lost_time, rtol=1e-9)
    assert (by_hand.failed == plain.failed).all()
    # Where a curve is flat, its peak is known to the root of what its height is.
    assert_allclose(by_hand.peak_time, plain.peak_time, atol=2e-7)
    # Another step would be another result, and a sweep that took no steps by C the very same.
    assert np.any(by_hand.peak_deflection != plain.peak_deflection)
    assert by_hand.attrs[FINGERPRINT_ATTRIBUTE] != plain.attrs[FINGERPRINT_ATTRIBUTE]


def test_a_beam_without_loads_stays_at_rest():
    case = dataclasses.replace(PLAIN, loads=[])
    found = jb.sweep(case, {"beam.flexural_rigidity": [9.0, 12.0]}, progress=False)
    assert np.all(found.peak_deflection == 0) and not found.failed.any()


NARROW = """
import sys
import jaxbeam as jb
from jaxbeam.integrator import native_peaks
from tests.integrator.test_native_peaks import COUPLED, GRID
native_peaks.LIBRARY.build()
assert native_peaks.available()
jb.sweep(COUPLED, GRID, progress=False).to_netcdf(sys.argv[1], engine="h5netcdf")
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="options of other compilers")
@pytest.mark.parametrize("without", ["avx512f", "avx"])
def test_narrower_machines_compute_the_same(without, tmp_path, monkeypatch):
    """In another process: one takes the steps of only one compiled library."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", f"{native_library.find_compiler()} -mno-{without}")
    path = tmp_path / "found.nc"
    subprocess.run([sys.executable, "-c", NARROW, str(path)], check=True, cwd=ROOT)
    monkeypatch.setattr(native_peaks, "available", lambda: False)
    plain = jb.sweep(COUPLED, GRID, progress=False).peak_deflection
    with xarray.open_dataset(path, engine="h5netcdf") as found:
        assert_allclose(found.peak_deflection, plain, rtol=1e-11)
        assert np.any(found.peak_deflection != plain)


def test_some_of_these_cases_lose_contact():
    lost = jb.sweep(WILD, {"loads.0.mass": [0.5, 5.0]}, progress=False).contact_lost_time
    assert np.isfinite(lost).any()


def marched(case, by_hand, longest=1e-3):
    """Peaks at the sensors of a single run, as a function of its mass (kg)."""
    known = static_shapes(case)

    def peaks(mass):
        varied = replace(case, {"loads.0.mass": mass})
        assembled = modal_model(varied, known.layout, known.coupled)
        grid, places = (
            grid_by_step_length(varied, assembled, jnp.asarray(longest)),
            varied.sensor_positions,
        )
        loads = load_set(varied)
        if not by_hand:
            best, _ = integrate_peaks(
                discrete_model(assembled, grid, places), loads, max_loads=known.max_loads
            )
            return best.refined_peak()[0][:, 0]
        given = jnp.ones((), bool), assembled, grid, places, loads
        of_one = jax.tree.map(lambda leaf: leaf[None], given)
        return native_peaks.integrate_peaks(known.max_loads, *of_one).peak_deflection[0, 0]

    return jax.jit(peaks)


@pytest.mark.parametrize("case", [PLAIN, COUPLED], ids=["plain", "coupled"])
def test_derivatives_are_those_without_it(case):
    mass = jnp.asarray(0.4)
    value, slope = jax.jvp(marched(case, True), (mass,), (jnp.ones(()),))
    plain, slope_without = jax.jvp(marched(case, False), (mass,), (jnp.ones(()),))
    assert_allclose(value, plain, rtol=1e-11)
    assert_allclose(slope, slope_without, rtol=1e-9)
    step = 1e-4
    above, below = (marched(case, True)(mass + sign * step) for sign in (1, -1))
    assert_allclose(slope, (above - below) / (2 * step), rtol=1e-6)


def test_batched_runs_take_one_after_the_other():
    masses = jnp.linspace(0.1, 1.0, 3)
    together = jax.vmap(marched(PLAIN, True))(masses)
    assert_allclose(together, jnp.stack([marched(PLAIN, True)(m) for m in masses]), rtol=1e-12)


def test_tasks_that_are_not_wanted_leave_the_others_alone():
    """Blocks that are not full, and those in which steps are measured, hold some of them."""
    case = dataclasses.replace(PLAIN, run=jb.Run(0.4))
    over = {"loads.0.mass": [0.2, 0.9], "loads.0.speed": np.linspace(1.0, 9.0, 1301)}
    by_hand = jb.sweep(case, over, progress=False).peak_deflection
    alone = jb.sweep(case, {**over, "loads.0.speed": over["loads.0.speed"][-3:]}, progress=False)
    assert_allclose(by_hand[:, -3:], alone.peak_deflection, rtol=1e-6)


def test_a_resumed_sweep_keeps_to_what_began_it():
    """Steps by C round otherwise: results of both must not meet in one store, where C serves."""

    def marks(histories, precision, case=PLAIN):
        for ready in (True, False):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(native_peaks, "available", lambda ready=ready: ready)
                order = sweep_specification(case, GRID, False, histories, 1e-7, precision)
                yield order.fingerprint()

    assert len(set(marks(False, "double"))) == 2
    assert len(set(marks(True, "double"))) == len(set(marks(False, "single"))) == 1
    controlled = dataclasses.replace(
        PLAIN,
        actuators=[jb.Patch(0.1, 0.2, moment_per_volt=1e-4)],
        controller=jb.PD(gains=[300.0], rate_gains=[3.0], lag=[0.002], period=0.004),
        sensors=SENSORS[:1],
    )
    assert len(set(marks(False, "double", controlled))) == 1


def planted(path, library):
    """Another library, under the right name: dlopen alone would run it."""
    path.write_bytes(library)


def with_a_plain_digest(path, library):
    path.write_bytes(hashlib.sha256(library).digest() + library)


def empty_but_authentic(path, library):
    write_file(path.name, b"")


def truncated(path, library):
    path.write_bytes(path.read_bytes()[:1000])


def linked(path, library):
    path.replace(path.parent / "elsewhere")
    path.symlink_to("elsewhere")


def writable_by_others(path, library):
    path.chmod(0o666)


def in_an_open_folder(path, library):
    path.parent.chmod(0o777)


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (planted, "was not written with the key of this user"),
        (with_a_plain_digest, "was not written with the key of this user"),
        (empty_but_authentic, "file too short"),
        (truncated, "is damaged"),
        (linked, "is a link"),
        (writable_by_others, "other users may write to"),
        (in_an_open_folder, "other users may write to"),
    ],
)
def test_a_library_that_others_can_have_written_is_refused(
    folder, monkeypatch, tmp_path, attack, message
):
    """In a folder of its own, as if in another process, which has not loaded the library."""
    name = native_peaks.LIBRARY.file_name
    library = read_file(name)
    assert library is not None and native_peaks.available()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = write_file(name, library)
    attack(path, library)
    monkeypatch.setattr(native_library, "_load", native_library._load.__wrapped__)
    with pytest.warns(UserWarning, match=f"C code not used: .*{message}.*`jaxbeam native` comp"):
        assert not native_peaks.available()
    assert not native_peaks.available()  # with no second warning


def test_whatever_is_included_decides_the_name_of_a_library():
    """Else one would be taken that was compiled from an older header."""
    folder, library = native_library.C_FOLDER, native_peaks.LIBRARY
    texts = [(folder / name).read_text() for name in library.sources + library.headers]
    included = re.findall(r'#include "(native_\w+\.h)"', "".join(texts))
    assert set(included) == set(library.headers)


def test_compilers_that_fail_are_told_of(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", "false")
    with pytest.raises(RuntimeError, match="the C compiler false cannot compile .*native.c"):
        native_peaks.LIBRARY.build()
    monkeypatch.setenv("CC", "/nowhere/cc")
    with pytest.raises(RuntimeError, match="the C compiler /nowhere/cc cannot be run"):
        native_peaks.LIBRARY.build()
    monkeypatch.delenv("CC")
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(RuntimeError, match="there is no C compiler here: install gcc or clang"):
        native_peaks.LIBRARY.build()
    assert not native_peaks.LIBRARY.library_path().exists()


def test_the_command_compiles_and_removes(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(SystemExit, match="0"):
        main(["native", "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert answer == {"path": str(native_peaks.LIBRARY.library_path()), "compiled": True}
    assert native_peaks.LIBRARY.library_path().exists() and native_peaks.available()
    with pytest.raises(SystemExit, match="0"):
        main(["native", "--remove"])
    assert "sweeps use XLA" in capsys.readouterr().out
    assert not native_peaks.LIBRARY.library_path().exists()


SEEK = """
#include "native_peaks.h"
void seek(const double *samples, const double *through, double *heights, int count) {
    for (int first = 0; first < count; first += WIDE) {
        const int many = count - first < WIDE ? count - first : WIDE;
        Lanes curve[POINTS];
        for (int p = 0; p < POINTS; p++) curve[p] = load(samples + p * count + first, many);
        const Curve found = curve_through(curve, through);
        store(heights + first, size_at(&found, find(&found)), many);
    }
}
"""


def test_places_of_peaks_are_as_high_as_those_found_without_it(tmp_path):
    """Of curves through any samples, many of which go up and down within a step."""
    curves = np.random.default_rng(0).normal(size=(len(PEAK_NODES), 2, 5000))
    curves[:, 1] = np.cumsum(curves[:, 1], axis=0)  # less wild
    curves = curves.reshape(len(PEAK_NODES), -1)
    (tmp_path / "seek.c").write_text(SEEK)
    headers = native_library.C_FOLDER
    words = [
        native_library.find_compiler(),
        *native_peaks.LIBRARY.compiler_flags,
        "-I",
        str(headers),
        "seek.c",
    ]
    subprocess.run([*words, "-o", "seek.so"], check=True, cwd=tmp_path)
    pointer = np.ctypeslib.ndpointer(float, flags="C")
    seek = ctypes.CDLL(str(tmp_path / "seek.so")).seek
    seek.argtypes = [pointer, pointer, pointer, ctypes.c_int]
    heights = np.empty(curves.shape[1])
    through = np.ascontiguousarray(
        peak_search.interpolation_matrix(PEAK_NODES)[: len(PEAK_NODES)].T
    )
    seek(curves, through, heights, heights.size)
    assert_allclose(
        heights, peak_search.refine_peak(jnp.asarray(curves), PEAK_NODES)[0], rtol=1e-11
    )

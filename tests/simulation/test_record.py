"""Records: shapes, quantities, verdicts, datasets and netCDF files; envelopes along the beam."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.analysis.sections import influence_table
from jaxbeam.case.case import replace
from jaxbeam.case.fields import PACKAGES, import_modules
from jaxbeam.case.library.published import trains
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.plot import plot_envelope
from jaxbeam.simulation import record as module
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.stored_record import record_from_xarray
from tests.simulation.test_every_number import subclasses

CASE = jb.Case(
    jb.Beam(1.2, 11.68, 0.535, 0.02, modes=3),
    supports=[jb.Support(0.5)],
    sensors=[
        jb.Sensor(0.25, offset=1e-4),
        jb.Sensor(0.8, "acceleration", offset=0.5),
        jb.Sensor(0.8, "strain", fibre_distance=0.0025),
        jb.Sensor(0.3, "slope"),
        jb.Sensor(0.3, "velocity"),
    ],
    loads=[
        jb.MovingMass(mass=0.4, speed=4.0),
        jb.MovingForce(force=3.0, speed=-2.0, entry_time=0.1),
    ],
    run=jb.Run(0.4, sample_rate=250.0),
    title="a run for its record",
)


@pytest.fixture(scope="module")
def record():
    return jb.simulate(CASE)


def test_shapes_of_arrays(record):
    assert record.times.shape == (101,)
    assert_allclose(record.times, np.arange(101) / 250.0)
    assert record.coordinates.shape == record.rates.shape == (101, 3)
    for quantity in ("deflection", "velocity", "acceleration", "slope", "strain", "measured"):
        assert getattr(record, quantity).shape == (101, 5)
    for quantity in (name for name, entry in QUANTITIES.items() if not entry.of_twist):
        assert record.at(CASE.sensor_positions, quantity, 0.002, 1e-3).shape == (101, 5)
    assert record.contact_force.shape == record.load_position.shape == (101, 2)
    assert record.peak_deflection.shape == record.peak_time.shape == (5,)


def test_reading_what_a_record_derives_leaves_its_tree():
    """A record of another structure would compile anew, and could not be compared by leaves."""
    fresh = jb.simulate(CASE)
    structure = jax.tree.structure(fresh)
    assert fresh.loads.weight.shape[0] == 2 and fresh.bodies == [] and fresh.verdict
    assert jax.tree.structure(fresh) == structure


def test_no_class_of_trees_keeps_what_it_derives():
    for package in PACKAGES:
        import_modules(package)
    kept = [
        f"{one.__name__}.{name}"
        for one in subclasses(eqx.Module)
        for name, value in vars(one).items()
        if isinstance(value, functools.cached_property)
    ]
    assert kept == []


def test_quantities_at_any_position(record):
    """Slope, strain and rates against differences of the deflection."""
    x, h = np.array([[0.2, 0.4], [0.7, 1.0]]), 1e-4
    low, middle, high = (record.at(x + d) for d in (-h, 0.0, h))
    assert middle.shape == (101, 2, 2)
    size = np.max(np.abs(middle))
    assert_allclose(record.at(x, "slope"), (high - low) / (2 * h), rtol=0, atol=1e-5 * size)
    low, middle, high = (jb.sections.corrected_deflection(record, x + d) for d in (-h, 0.0, h))
    bend = -0.002 * (high - 2 * middle + low) / h**2
    loads_near = np.abs(record.load_position[..., None] - x.ravel()).min(axis=1) < h
    away = ~loads_near.reshape(bend.shape)
    assert_allclose(record.at(x, "strain", 0.002)[away], bend[away], rtol=0, atol=1e-5 * size)
    assert_allclose(record.at(0.5), 0.0, atol=1e-12 * size)  # a rigid support
    assert record.at(0.2).shape == (101,)
    spline = np.gradient(np.asarray(record.at(0.3)), record.times[1])[1:-1]
    velocity = record.at(0.3, "velocity")[1:-1]
    assert_allclose(spline, velocity, rtol=0, atol=0.1 * np.max(np.abs(velocity)))
    spline = np.gradient(np.asarray(record.at(0.3, "velocity")), record.times[1])[1:-1]
    error = np.abs(spline - record.at(0.3, "acceleration")[1:-1])
    assert np.median(error) < 0.2 * np.max(np.abs(record.at(0.3, "acceleration")))


def test_readings_are_quantities_plus_offsets(record):
    columns = [
        record.at(0.25) + 1e-4,
        record.at(0.8, "acceleration") + 0.5,
        record.at(0.8, "strain", 0.0025),
        record.at(0.3, "slope"),
        record.at(0.3, "velocity"),
    ]
    assert_allclose(record.measured, np.array(columns).T, rtol=1e-12)
    assert_allclose(record.deflection[:, 0], record.at(0.25), rtol=1e-12)
    assert_allclose(record.strain[:, 2], record.at(0.8, "strain", 0.0025), rtol=1e-12)
    assert np.isnan(record.strain[:, 0]).all()


def test_extremes_of_what_is_measured(record):
    """Signed, between samples too: those of denser samples, and at rest zero.

    A load is on the beam at the end, where an acceleration must not be that without it.
    """
    values, found = np.asarray(record.sensor_values), record.extremes
    assert_allclose(values[:, 2], record.at(0.8, "strain", 0.0025))
    dense = jb.simulate(record.case, np.linspace(0.0, float(record.times[-1]), 4001))
    exact = np.asarray(dense.sensor_values)
    size = np.abs(exact).max(axis=0)
    assert np.all(np.abs(found.smallest - np.minimum(exact.min(axis=0), 0)) < 1e-3 * size)
    assert np.all(np.abs(found.largest - np.maximum(exact.max(axis=0), 0)) < 1e-3 * size)
    assert np.all(found.smallest <= values.min(axis=0) + 1e-9 * size)
    assert np.all(found.largest >= values.max(axis=0) - 1e-9 * size)
    assert_allclose(found.smallest[0], -record.peak_deflection[0])
    assert found.smallest_time[0] == record.peak_time[0]
    assert found.smallest[0] < values[:, 0].min() < 0


def test_named_sensors_and_their_units_in_datasets(tmp_path):
    sensors = [jb.Sensor(0.3, "velocity", name="midspan"), jb.Sensor(0.25)]
    case = dataclasses.replace(CASE, sensors=sensors)
    jb.save_case(case, tmp_path / "case.toml")
    assert jb.load_case(tmp_path / "case.toml").sensors[0].name == "midspan"
    record = jb.simulate(case)
    record.to_netcdf(tmp_path / "run.nc")
    with xarray.open_dataset(tmp_path / "run.nc", engine="scipy") as dataset:
        assert dataset["sensor"].values.tolist() == ["midspan", "1: deflection"]
        assert dataset["quantity"].values.tolist() == ["velocity", "deflection"]
        assert dataset["unit"].values.tolist() == ["m/s", "m"]
        largest = float(dataset["largest"].sel(sensor="midspan"))
        assert largest == record.extremes.largest[0] >= np.max(record.at(0.3, "velocity"))
    assert jb.read_record(tmp_path / "run.nc").case.sensors[0].name == "midspan"


def test_unknown_quantity_is_refused(record):
    with pytest.raises(ValueError, match="no quantity 'force'; there are deflection"):
        record.at(0.3, "force")
    with pytest.raises(ValueError, match="fibre_distance"):
        record.at(0.3, "strain")


def assert_same(found, expected):
    """Equality of two records, bit by bit."""
    for name, value in vars(expected).items():
        other = getattr(found, name)
        assert jax.tree.structure(value) == jax.tree.structure(other), name
        for a, b in zip(jax.tree.leaves(value), jax.tree.leaves(other), strict=True):
            assert_array_equal(a, b, err_msg=name)


def test_netcdf_file_restores_the_record_exactly(record, tmp_path):
    path = tmp_path / "run.nc"
    record.to_netcdf(path)
    assert_same(jb.read_record(path), record)


def test_dataset_has_labels_and_units(record):
    dataset = record.to_xarray()
    assert dataset.attrs["title"] == "a run for its record"
    assert dataset.deflection.dims == ("time", "sensor")
    assert dataset.measured.shape == (101, 5) and dataset.contact_force.shape == (101, 2)
    assert dataset.deflection.attrs["units"] == "m"
    assert dataset.contact_force.attrs["units"] == "N"
    assert dataset.time.attrs["units"] == "s"
    assert list(dataset.sensor.values[:2]) == ["0: deflection", "1: acceleration"]
    assert all("units" in v.attrs and "long_name" in v.attrs for v in dataset.data_vars.values())
    assert_array_equal(dataset.deflection.sel(sensor="0: deflection"), record.deflection[:, 0])
    later = dataset.sel(time=0.1, method="nearest")
    assert_array_equal(later.measured, record.measured[25])


def test_existing_file_is_kept_without_overwrite(record, tmp_path):
    path = tmp_path / "run.nc"
    path.write_text("precious")
    with pytest.raises(FileExistsError, match="exists already"):
        record.to_netcdf(path)
    assert path.read_text() == "precious"
    record.to_netcdf(path, overwrite=True)
    assert jb.read_record(path).case.title == "a run for its record"


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="not a record of jaxbeam"):
        record_from_xarray(xarray.Dataset({"deflection": ("time", np.zeros(3))}))
    with pytest.raises(OSError, match="absent.nc"):
        jb.read_record(tmp_path / "absent.nc")


def test_verdict_names_contact_loss_and_error(record):
    assert record.verdict.startswith("every load presses on the beam throughout; estimated error")
    nan = jnp.nan
    lost = eqx.tree_at(
        lambda r: (r.contact_lost_time, r.contact_lost_position, r.lowest_contact_force),
        record,
        (jnp.array([0.25, nan]), jnp.array([0.9, nan]), jnp.array([-0.5, 1.0])),
    )
    assert "load 0 loses contact, first at t = 0.25 s, x = 0.9 m" in lost.verdict
    assert "(smallest contact force -0.5 N)" in lost.verdict
    assert "load 1" not in lost.verdict


def test_verdict_says_which_loads_press():
    """In 0.5 s on a beam of 1 m: a mass of 0 kg, a force that starts at 0 N, a late force."""
    beam, run = jb.Beam(1.0, 10.0, 1.0, modes=2), jb.Run(0.5, sample_rate=20.0)
    ball, nothing = jb.MovingMass(0.1, 4.0), jb.MovingMass(0.0, 4.0)
    rising = jb.VaryingForce(force_times=[0.0, 0.2], forces=[0.0, 3.0], position=0.5)
    absent = jb.MovingForce(force=1.0, speed=4.0, entry_time=0.7)
    for loads, words in (
        ([], "the case has no loads"),
        ([ball], "every load presses on the beam throughout"),
        ([nothing], "load 0 has no weight"),
        ([nothing, nothing], "loads 0, 1 have no weight"),
        ([rising], "the force of load 0 falls to 0 N"),
        ([absent], "no load is on the beam during the run"),
        (
            [ball, nothing, absent],
            "load 1 has no weight; load 2 is not on the beam; every other load presses on the beam"
            " throughout",
        ),
    ):
        verdict = jb.simulate(jb.Case(beam, loads=loads, run=run)).verdict
        assert verdict.split("; estimated error")[0] == words


def test_record_without_loads_and_sensors(tmp_path):
    case = jb.Case(jb.Beam(1.0, 10.0, 1.0, modes=2), run=jb.Run(0.1))
    record = jb.simulate(case)
    assert record.deflection.shape == (101, 0) and record.contact_force.shape == (101, 0)
    assert not np.any(record.coordinates)
    measured = jb.simulate(dataclasses.replace(case, sensors=(jb.Sensor(0.5),)))
    assert not np.signbit(measured.extremes.smallest[0])  # printed as 0, not -0
    record.to_netcdf(tmp_path / "nothing.nc")
    assert_same(jb.read_record(tmp_path / "nothing.nc"), record)


def test_text_has_the_extremes_of_each_sensor(record):
    lines = repr(record).splitlines()
    assert lines[0] == "Record of 'a run for its record': 101 samples to 0.4 s, 5 sensors, 2 loads"
    assert lines[1].strip() == record.verdict
    assert lines[2].split() == ["sensor", "position", "quantity", "smallest", "at", "largest", "at"]
    found = record.extremes
    assert f"{1e3 * found.smallest[0]:.4g} mm  {found.smallest_time[0]:.4g} s" in lines[3]
    largest, time = f"{found.largest[1]:.4g}", f"{found.largest_time[1]:.4g}"
    assert lines[4].split()[-4:] == [largest, "m/s²", time, "s"]
    several = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), record)
    assert repr(several) == "Record of 'a run for its record', traced or of several runs"
    shown = record._repr_html_()
    assert f"<p>{record.verdict}</p>" in shown and shown.count("<tr>") == 6
    assert f"{1e3 * found.smallest[0]:.4g} mm" in shown and several._repr_html_() is None


def test_text_of_modes(record):
    head, titles, first, *_ = repr(record.modes).splitlines()
    assert head == "Modes: 3 of the beam"
    assert titles.split("  ")[1:] == ["mode", "frequency (Hz)", "damping ratio"]
    assert first.split() == ["1", f"{record.modes.frequencies[0]:.6g}", "0.02"]


def test_text_of_an_envelope_names_its_extremes(record):
    """The largest deflection of a positive load is near midspan; the table ends at the beam's."""
    found = record.envelope("deflection", np.linspace(0, record.case.beam.length, 41))
    lines = str(found).splitlines()
    largest = found.largest.argmax()
    words = f"largest {1e3 * found.largest[largest]:.4g} mm at {found.positions[largest]:.6g} m"
    assert lines[0].startswith("Envelope of deflection: smallest ") and words in lines[0]
    assert "... 21 more ..." in lines[-2]
    assert lines[-1].split()[0] == f"{float(record.case.beam.length):.6g}" and len(lines) == 23


def test_texts_of_plants_and_simulators(record):
    plant = jb.state_space(record.case)
    assert str(plant).startswith("Plant of 'a run for its record': 3 modes in q (m kg^0.5)")
    lines = str(plant.at(0.1)).splitlines()
    assert lines[0] == "StateSpace: z' = A z + B u, y = C z + D u"
    assert [line.split(":")[0].strip() for line in lines[1:]] == ["states", "inputs", "outputs"]
    assert lines[1].count(",") == 5 and "sensor_0_deflection (m)" in lines[3]
    assert "z_(k+1) = A z_k + B u_k" in str(plant.at(0.1).discretize(1e-3))
    simulator = jb.Simulator(record.case, vary=["loads.0.speed"])
    assert str(simulator) == "Simulator of 'a run for its record': varies loads.0.speed"


# Envelopes along the beam against closed forms of a slow crossing, and continuous peaks.

BEAM = jb.Beam(length=30.0, flexural_rigidity=3e10, mass_per_length=1e4, damping_ratio=0.1)
SLOW = jb.Case(
    dataclasses.replace(BEAM, modes=3),
    loads=[jb.MovingForce(force=1e5, speed=0.25)],
    run=jb.Run(121.0, sample_rate=20.0),
)
X = np.linspace(0.0, 30.0, 21)


@pytest.fixture(scope="module")
def slow():
    return jb.simulate(SLOW)


def test_moments_of_a_slow_force(slow):
    """Largest P x (L - x) / L with the force at x, smallest zero."""
    found = slow.envelope("moment", X)
    expected = 1e5 * X * (30 - X) / 30
    assert_allclose(found.largest, expected, rtol=0, atol=1e-3 * expected.max())
    assert_allclose(found.smallest, 0.0, atol=1e-3 * expected.max())
    inner = slice(2, -2)
    assert_allclose(found.largest_load_position[inner, 0], X[inner], atol=0.05)
    assert_allclose(found.largest_time, 4 * found.largest_load_position[:, 0], rtol=1e-9)
    stress = slow.envelope("stress", X, section_modulus=-0.5)
    assert_allclose(stress.smallest, -found.largest / 0.5, rtol=1e-12)


def test_shear_on_both_sides_of_a_slow_force(slow):
    """P (1 - x / L) with the force just right of x, -P x / L with the force just left of it."""
    found = slow.envelope("shear", X)
    assert_allclose(found.largest[1:], 1e5 * (1 - X / 30)[1:], rtol=0, atol=1e3)
    assert_allclose(found.smallest[:-1], -1e5 * (X / 30)[:-1], rtol=0, atol=1e3)


def test_coincident_shear_of_the_largest_moment(slow):
    """With the force at x its shear forces there are P (1 - x / L) and -P x / L: the larger."""
    found = slow.envelope("moment", X, coincident="shear")
    share = X[2:-2] / 30
    expected = 1e5 * np.maximum(share, 1 - share)
    assert_allclose(np.abs(found.largest_coincident[2:-2]), expected, rtol=0, atol=1e3)
    assert list(found.columns)[-1] == "shear (N) at largest"
    assert found.to_xarray()["largest_coincident"].attrs["units"] == "N"


def test_deflections_are_those_between_samples_nearly():
    case = dataclasses.replace(
        SLOW, loads=[jb.MovingMass(mass=2e4, speed=25.0)], run=jb.Run(2.0, sample_rate=1000.0)
    )
    found, exact = jb.simulate(case).envelope("deflection", X), jb.envelope(case, X)
    size = np.abs(exact.lowest).max()
    assert_allclose(found.smallest, exact.lowest, rtol=0, atol=1e-4 * size)
    assert_allclose(found.largest, exact.highest, rtol=0, atol=1e-4 * size)


def test_positions_in_parts_and_traced_numbers(slow, monkeypatch):
    whole = slow.envelope("moment")
    assert 101 <= whole.positions.shape[0] < 200
    times = np.linspace(0, 120, 41)
    plan = integration_plan(SLOW, times)

    def largest(force):
        changed = replace(SLOW, {"loads.0.force": force})
        return jb.simulate(changed, times, plan).envelope("moment", X[5:8]).largest

    value, slope = jax.jit(lambda force: jax.jvp(largest, (force,), (1.0,)))(1e5)
    assert_allclose(slope, value / 1e5, rtol=1e-9)  # linear in the force
    monkeypatch.setattr(module, "MAX_ENTRIES", 20_000)
    parts = slow.envelope("moment")
    for one, other in zip(*map(jax.tree.leaves, (parts, whole)), strict=True):
        assert_allclose(one, other, rtol=1e-10, atol=1e-6)


# The extremes along the beam: peaks over piers

SPANS = 25.0, 35.0, 25.0
PIERS = np.cumsum(SPANS)[:2]
CONTINUOUS = jb.Case(
    jb.Beam(sum(SPANS), flexural_rigidity=3e10, mass_per_length=1e4, damping_ratio=0.1, modes=8),
    supports=[jb.Support(x) for x in PIERS],
    loads=[jb.MovingForce(force=3e5, speed=0.5)],
    run=jb.Run(172.0, sample_rate=10.0),
)


def pier_moments(force, y) -> np.ndarray:
    """Moments at both piers under a force at y, by the three-moment equation (Clapeyron)."""
    starts, right = np.concatenate([[0.0], PIERS]), np.zeros(2)
    for i, (start, length) in enumerate(zip(starts, SPANS, strict=True)):
        if start <= y <= start + length:
            a, b = y - start, start + length - y
            if i < 2:
                right[i] -= force * a * (length**2 - a**2) / length
            if i > 0:
                right[i - 1] -= force * b * (length**2 - b**2) / length
    first, middle, last = SPANS
    matrix = [[2 * (first + middle), middle], [middle, 2 * (middle + last)]]
    return np.linalg.solve(matrix, right)


def test_peaks_over_piers_of_a_slow_force():
    """25 and 60 m are on no grid of 101 positions of 85 m: these miss 1.5 to 4 %."""
    record = jb.simulate(CONTINUOUS)
    found = record.envelope("moment")
    moments = np.array([pier_moments(3e5, y) for y in np.linspace(0.0, 85.0, 3401)])
    assert_allclose(found.smallest.min(), moments.min(), rtol=5e-4)
    at_pier = np.isin(found.positions, PIERS)
    assert_allclose(found.smallest[at_pier], moments.min(axis=0), rtol=5e-4)
    assert_allclose(found.largest[at_pier], moments.max(axis=0), rtol=2e-3)
    at_piers = np.asarray(record.bending_moment(PIERS))
    assert_allclose(found.smallest.min(), at_piers.min(), rtol=1e-12)
    grid = record.envelope("moment", np.linspace(0.0, 85.0, 101))
    assert grid.smallest.min() > 0.99 * found.smallest.min()
    dense = record.envelope("moment", np.linspace(30.0, 55.0, 2501))  # in the middle span
    assert_allclose(found.largest.max(), dense.largest.max(), rtol=1e-4)


def test_envelopes_between_samples_have_the_same_extremes():
    """At 20 m/s, from samples and between them, over a pier and in the middle span."""
    case = replace(CONTINUOUS, {"loads.0.speed": 20.0, "run.duration": 5.0})
    case = replace(case, {"run.sample_rate": 1000.0, "beam.damping_ratio": 0.01})
    record = jb.simulate(case).envelope("moment")
    case = replace(case, {"run.sample_rate": 50.0})
    exact = jb.envelope(case, quantity="moment")
    assert_allclose(exact.lowest.min(), record.smallest.min(), rtol=1e-4)
    assert_allclose(exact.highest.max(), record.largest.max(), rtol=2e-4)
    assert set(PIERS) <= set(np.asarray(exact.positions))
    shear = jb.envelope(case, [25.0, 24.99, 25.01], quantity="shear")
    assert_allclose(shear.lowest[0], shear.lowest[1], rtol=1e-3)  # the left side
    assert_allclose(shear.highest[0], shear.highest[2], rtol=1e-3)  # the right side
    assert shear.highest[0] > 10 * shear.highest[1]


# Three bridges whose piers lie between 101 equal positions: there these miss 1.4 to 4 %.

TRUCK = trains()["HL93-truck"]
FAST = replace(CONTINUOUS, {"loads.0.speed": 20.0, "run.duration": 5.0, "run.sample_rate": 200.0})
FAST = replace(FAST, {"beam.damping_ratio": 0.01, "beam.mass_per_length": 15e3})
FAST = dataclasses.replace(FAST, beam=dataclasses.replace(FAST.beam, modes=12))


def test_moments_over_piers_of_a_fast_force():
    """300 kN at 20 m/s: -969.7 kN m over a pier, in envelope, figure, sensors and sweep alike."""
    sensors = [jb.Sensor(x, "moment") for x in PIERS]
    record = jb.simulate(dataclasses.replace(FAST, sensors=sensors))
    found = record.envelope("moment")
    assert_allclose(found.smallest.min(), -969.7e3, rtol=1e-4)
    assert_allclose(found.smallest.min(), np.min(record.bending_moment(PIERS)), rtol=1e-9)
    assert_allclose(np.min(record.extremes.smallest), found.smallest.min(), rtol=1e-4)
    *_, lowest, _, _, _ = plot_envelope(record, "moment").axes[-1].get_lines()
    assert_allclose(np.min(lowest.get_ydata()), found.smallest.min() / 1e6, rtol=1e-9)
    swept = jb.sweep(record.case, {"loads.0.speed": np.array([20.0])}, progress=False)
    peaks = np.max([-record.extremes.smallest, record.extremes.largest], axis=0)
    assert_allclose(swept.peak_moment[0], peaks, rtol=1e-5)


def test_moments_over_piers_of_a_truck():
    """HL-93, its axles by the three-moment equation: -1004.8 kN m, at rest and slowly."""
    x = np.arange(0.0, 95.0, 0.01)
    forces = np.broadcast_to(TRUCK.forces, TRUCK.offsets.shape)
    moments = sum(
        np.array([pier_moments(force, y) * (0.0 <= y <= 85.0) for y in x - offset])
        for force, offset in zip(forces, TRUCK.offsets, strict=True)
    )
    assert_allclose(moments.min(), -1004.8e3, rtol=1e-6)
    case = dataclasses.replace(CONTINUOUS, loads=(jb.Axles(train="HL93-truck", speed=0.5),))
    static = [float(jb.statics.static_peak(case, x, quantity="moment")) for x in PIERS]
    assert_allclose(static, np.abs(moments).max(axis=0), rtol=1e-6)
    table = influence_table(case, ("moment",), tuple(PIERS))
    lines = [[pier_moments(1.0, y)[i] for y in table.positions] for i in (0, 1)]
    assert_allclose(np.asarray(table.values).T, lines, atol=1e-9)
    case = replace(case, {"run.duration": 190.0, "run.sample_rate": 10.0})
    found = jb.simulate(case).envelope("moment")
    assert_allclose(found.smallest.min(), moments.min(), rtol=5e-4)

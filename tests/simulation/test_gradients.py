"""Derivatives of peaks and readings by every number, of batches, and at corners of the response."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.differences import central

# A load loses contact on entry at the free end; the bilateral model is smooth there.
pytestmark = pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")

TIMES = np.linspace(0.0, 0.4, 44)  # s; loads enter, leave and speed up between two of them

ONE_SPAN = jb.Case(
    jb.Beam(
        length=0.6,
        ends="pinned-clamped",
        modes=3,
        damping_ratio=[0.03, 0.02, 0.01],
        width=0.04,
        height=0.005,
        youngs_modulus=2.8e10,
        density=2675.0,
    ),
    sensors=[jb.Sensor(0.25, offset=1e-4), jb.Sensor(0.4, "strain", 2e-6, 0.0025)],
    loads=[
        jb.MovingMass(mass=0.4, speed=2.5, entry_time=0.013, deceleration=1.5),
        jb.MovingForce(force=3.0, times=[0.05, 0.12, 0.2, 0.31], positions=[0.1, 0.2, 0.45, 0.7]),
    ],
    run=jb.Run(0.5),
)
TWO_SPANS = jb.Case(
    jb.Beam(1.2, 11.68, 0.535, ends="pinned-free", modes=3, rayleigh_damping=[0.8, 2e-4]),
    supports=[
        jb.Support(0.55, rotational_stiffness=3.0),
        jb.Support(1.0, stiffness=6e3, damping=5.0, rotational_stiffness=1.0),
    ],
    actuators=[
        jb.Shaker(0.3, stiffness=500.0, damping=8.0, force_per_volt=4.6, bandwidth=900.0),
        jb.Patch(0.7, 0.85, 8e-4, correction=0.3, added_mass=0.05, added_rigidity=2.0),
    ],
    sensors=[jb.Sensor(0.25, offset=1e-4), jb.Sensor(0.8, "velocity", offset=0.01)],
    loads=[
        jb.MovingMass(mass=0.4, speed=3.5, entry_time=0.013, deceleration=0.6),
        jb.MovingMass(mass=0.3, speed=-1.2, entry_time=0.05, deceleration=5.0),  # stops and stays
    ],
    run=jb.Run(0.5),
)


class Problem:
    """Peaks and a misfit as functions of all numbers of a case, relative to their values."""

    def __init__(self, case):
        found = jb.addresses(case)
        entries = [a for a in found if jnp.ndim(found[a]) == 0]
        values = np.array([found[a] for a in entries])
        self.case, self.addresses, self.sizes = case, entries, np.where(values == 0, 1, values)
        self.point = values / self.sizes
        self.plan = integration_plan(case, TIMES)
        record = jb.simulate(case, TIMES, self.plan)
        self.peaks = record.peak_deflection
        self.scale = np.std(record.measured, axis=0)
        self.data = record.measured + self.scale * np.cos(np.arange(TIMES.size))[:, None]

    def outputs(self, point):
        """Relative peaks, and the mean square of normalised residuals of the readings."""
        case = jb.replace(self.case, dict(zip(self.addresses, point * self.sizes, strict=True)))
        record = jb.simulate(case, TIMES, self.plan)
        misfit = xp.mean(((record.measured - self.data) / self.scale) ** 2)
        return xp.concatenate([record.peak_deflection / self.peaks, misfit[None]])


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
@pytest.mark.parametrize("case", [ONE_SPAN, TWO_SPANS], ids=["one span", "two spans"])
def test_gradients_agree_with_differences(case, mode):
    problem = Problem(case)
    # Runs of known numbers, which no program computes.
    differences = central(problem.outputs, problem.point, step=2e-4, order=4)
    found = jax.jit(mode(problem.outputs))(jnp.asarray(problem.point))
    for i, address in enumerate(problem.addresses):
        # The absolute tolerance is the rounding of the outputs.
        assert_allclose(found[:, i], differences[:, i], rtol=1e-6, atol=1e-9, err_msg=address)


def test_a_sensor_moves_under_steps_of_several_lengths():
    """Only the rows of the sensor are traced: steps before and after the exit are known."""
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=5, ends="clamped-clamped"),
        sensors=[jb.Sensor(0.2)],
        loads=[jb.MovingMass(mass=0.3, speed=2.0)],
        run=jb.Run(0.35, 400.0),
    )

    def peak(position):
        return jb.simulate(jb.replace(case, {"sensors.0.position": position})).peak_deflection[0]

    slope = jax.jvp(peak, (0.2,), (1.0,))[1]
    assert_allclose(slope, (peak(0.2 + 1e-5) - peak(0.2 - 1e-5)) / 2e-5, rtol=1e-5)


OUTPUTS = (
    *("reactions", "sensor_values", "deflection", "measured", "truncation_errors"),
    *("peak_command", "effort", "stroke", "absorber_force", "absorber_energy"),
)
WITHOUT_DERIVATIVE = "error_estimate", "step_errors"


def test_all_numbers_of_a_record_have_their_derivative_or_refuse_it():
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=3),
        sensors=[jb.Sensor(0.25), jb.Sensor(0.2, "moment"), jb.Sensor(0.4, "acceleration")],
        actuators=[jb.PointForce(0.45)],
        controller=jb.Feedback([300.0], period=0.002),
        absorbers=[jb.Absorber(0.3, mass=0.05, stiffness=100.0, damping=0.2)],
        loads=[jb.MovingMass(mass=0.8, speed=6.0)],  # loses contact
        run=jb.Run(0.2, 200.0),
    )

    def outputs(mass):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass}))
        envelope = record.envelope("moment", np.array([0.2, 0.3]))
        names = [*(field.name for field in dataclasses.fields(record)), *OUTPUTS]
        found = {name: getattr(record, name) for name in names}
        found |= {f"envelope.{name}": getattr(envelope, name) for name in ("smallest", "largest")}
        floats = (k for k, v in found.items() if getattr(v, "size", 0) and v.dtype.kind == "f")
        return {k: found[k] for k in floats}

    _, tangents = jax.jvp(outputs, (0.8,), (1.0,))
    pairs = {step: (outputs(0.8 + step), outputs(0.8 - step)) for step in (1e-4, 1e-3)}
    assert len(tangents) > 30
    for name, tangent in tangents.items():
        if name in WITHOUT_DERIVATIVE:
            assert np.all(np.isnan(tangent))
            with pytest.raises(ValueError, match=f"{name} of a record has no derivative"):
                jax.grad(lambda mass, name=name: xp.sum(outputs(mass)[name]))(0.8)
        else:
            step = 1e-3 if name.endswith("_time") else 1e-4  # instants are located to 1e-10 s
            above, below = (np.asarray(one[name]) for one in pairs[step])
            slopes = (above - below) / (2 * step)
            scale = np.nanmax(np.abs(slopes), initial=0.0)
            tangent = np.where(np.isnan(slopes), np.nan, tangent)
            assert_allclose(tangent, slopes, rtol=0, atol=1e-5 * scale, err_msg=name)


EVENT = 0.1  # s, a sample
CORNER_TIMES = np.array([0.0, EVENT, 0.15])
STEP = 1e-6
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, ends="free-clamped", damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.05)],
    loads=[jb.MovingForce(force=3.0, speed=2.0, entry_time=EVENT)],
    run=jb.Run(0.2),
)


def derivative(function, at: float) -> float:
    return float(jax.jit(jax.jacfwd(function))(at))


def test_a_sample_at_an_entry_has_the_derivative_of_later_entries():
    """The force enters at the free end, where the velocity has a corner in its entry time."""
    plan = integration_plan(CASE, CORNER_TIMES)

    def velocity(entry):
        case = jb.replace(CASE, {"loads.0.entry_time": entry})
        return jb.simulate(case, CORNER_TIMES, plan).velocity[1, 0]

    at, later, earlier = (float(velocity(EVENT + side * STEP)) for side in (0.0, 1.0, -1.0))
    assert abs(at - earlier) / STEP > 1.0
    assert at == later == derivative(velocity, EVENT) == 0.0


def test_the_time_of_a_loss_has_the_derivative_of_the_crossing():
    case = jb.Case(
        jb.Beam(2.0, 50.0, 1.5, damping_ratio=0.01, modes=3),
        sensors=[jb.Sensor(1.0)],
        loads=[jb.MovingMass(mass=3.0, speed=15.0)],
        run=jb.Run(0.1, 1000.0),
    )
    plan = integration_plan(case)

    def lost(mass):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass}), plan=plan)
        return record.contact_lost_time[0]

    with pytest.warns(ContactLossWarning):
        difference = (float(lost(3.01)) - float(lost(2.99))) / 0.02
    assert abs(difference) > 1e-4
    assert_allclose(derivative(lost, 3.0), difference, rtol=0.02)


EXIT = 0.6 / 3.0  # s
ENTRIES = EXIT, np.nextafter(EXIT, 1.0), np.nextafter(EXIT, 0.0), EXIT + 1e-14, EXIT - 1e-14
TIED = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=3),
    sensors=[jb.Sensor(0.2)],
    loads=[jb.MovingMass(mass=0.4, speed=3.0), jb.MovingMass(mass=0.3, speed=-2.5)],
    run=jb.Run(0.5, sample_rate=137.3),
)


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_exit_and_an_entry_at_one_time(entry):
    """Differences cross the tie of both events, which the derivatives stand on."""
    addresses = "loads.0.speed", "loads.1.entry_time", "loads.1.mass", "beam.flexural_rigidity"
    at = np.array([3.0, entry, 0.3, 11.68])

    def outputs(shares):
        values = [value * (1 + share) for value, share in zip(at, shares, strict=True)]
        values = dict(zip(addresses, values, strict=True))
        record = jb.simulate(jb.replace(TIED, values), tolerance=1e-10)
        return 1e3 * xp.append(record.deflection[[20, 40, 60], 0], record.peak_deflection)

    found = np.stack([jax.grad(lambda s, i=i: outputs(s)[i])(np.zeros(4)) for i in range(4)])
    assert_allclose(found, central(outputs, np.zeros(4), 1e-4, 4), rtol=1e-5, atol=1e-6)


BATCH_TIMES = np.array([0.0, 0.17, 0.3])  # s; no wheel passes a sensor or an end then
SPEEDS = jnp.array([2.5, 4.0])  # m/s
BATCH = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.25), jb.Sensor(0.25, "moment"), jb.Sensor(0.25, "acceleration")],
    loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    run=jb.Run(0.3),
)
NUMBERS = {"loads.0.mass": 0.4, "beam.flexural_rigidity": 11.68, "sensors.*.position": 0.25}


def test_gradients_of_peaks_of_a_batch():
    """Peaks between samples of deflection, statically corrected moment and acceleration."""
    plan, sizes = integration_plan(BATCH, BATCH_TIMES), np.array(list(NUMBERS.values()))

    def peaks(shares, speed):
        numbers = dict(zip(NUMBERS, shares * sizes, strict=True)) | {"loads.0.speed": speed}
        record = jb.simulate(jb.replace(BATCH, numbers), BATCH_TIMES, plan)
        return xp.maximum(record.largest, -record.smallest)

    def single_runs(shares):
        return np.stack([peaks(shares, speed) for speed in np.asarray(SPEEDS)])

    ones, batch = np.ones(sizes.size), jax.vmap(peaks, in_axes=(None, 0))
    found = jax.jit(jax.jacfwd(batch))(jnp.asarray(ones), jnp.asarray(SPEEDS))
    expected, scale = central(single_runs, ones, step=1e-4), np.abs(single_runs(ones))[..., None]
    assert_allclose(found / scale, expected / scale, rtol=1e-5, atol=1e-7)

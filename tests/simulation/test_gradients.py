"""Derivatives of peaks and readings by every number of a case, against differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.integration_plan import integration_plan
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

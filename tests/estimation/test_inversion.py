"""Inversion of mode shapes against numpy and scipy; errors and warnings of sets of sensors."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.design_model import DesignModel
from jaxbeam.estimation.inversion import Inversion
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.estimation.observability import ConditioningWarning, conditioning
from jaxbeam.estimation.observer import Observer
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.modes import mesh_layout
from tests.differences import central
from tests.loop_as_oracle import span_of

PERIOD = 2e-3


def loop(positions, estimator=None, modes=3, quantity="deflection", design=None):
    count = modes if design is None or design.modes is None else design.modes
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=modes),
        actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
        sensors=[jb.Sensor(x, quantity, offset=1e-4) for x in positions],
        controller=jb.StateFeedback(
            np.zeros((1, 2 * count + 1)),
            period=PERIOD,
            delay=5e-4,
            estimator=Inversion(time_constant=0.01) if estimator is None else estimator,
            design=design,
        ),
    )


def estimates(case, readings, commands):
    """States (sample, state) by the inversion, from readings and commands (sample, ...)."""
    controller, layout = case.controller, mesh_layout(case)

    @jax.jit
    def run(case):
        plant = jb.state_space(case, layout=layout)
        filter = controller.estimator.sampled_filter(plant, sample_timing(controller))

        def update(state, sample):
            measurement = Measurement(sample[0], jnp.zeros(0), sample[1])
            estimate, state = filter.update(state, measurement, jnp.zeros(()))
            return state, estimate.state

        samples = jnp.asarray(readings), jnp.asarray(commands)
        return jax.lax.scan(update, filter.initial_state(), samples)[1]

    return np.asarray(run(case))


@pytest.mark.parametrize(
    "positions", [[0.15, 0.25, 0.35], [0.1, 0.2, 0.3, 0.45, 0.5], [0.15, 0.25]], ids=len
)
def test_coordinates_rates_and_states_of_actuators(positions):
    """Exact, least-squares or least-norm coordinates; rates by scipy's filter of differences."""
    case = loop(positions)
    random = np.random.default_rng(len(positions))
    readings = 1e-3 * random.normal(size=(40, len(positions))) + 1e-4
    commands = random.normal(size=(40, 1))
    found = estimates(case, readings, commands)
    rows = span_of(case).shapes(np.array(positions))
    modal = np.linalg.lstsq(rows, (readings - 1e-4).T, rcond=None)[0].T
    assert_allclose(found[:, :3], modal, rtol=1e-9, atol=1e-12)
    lag = np.exp(-PERIOD / 0.01)
    numerator = (1 - lag) / PERIOD * np.array([1.0, -1.0])
    rates = scipy.signal.lfilter(numerator, [1.0, -lag], modal, axis=0)
    assert_allclose(found[:, 3:6], rates, rtol=1e-9, atol=1e-9)
    # Lag of the shaker: the previous command acts for 0.5 ms, then the one of the sample.
    lagged, previous = 0.0, 0.0
    for command, state in zip(commands[:, 0], found[:, 6], strict=True):
        lagged = previous + (lagged - previous) * np.exp(-400.0 * 5e-4)
        lagged = command + (lagged - command) * np.exp(-400.0 * (PERIOD - 5e-4))
        assert state == pytest.approx(lagged, rel=1e-9)
        previous = command


def test_conditioning():
    """Ratio of singular values, and its gradient by the positions of sensors."""
    case = loop([0.15, 0.25, 0.35])

    @jax.jit
    def condition_number(positions):
        moved = {f"sensors.{i}.position": positions[i] for i in range(3)}
        model = jb.state_space(jb.replace(case, moved), layout=mesh_layout(case))
        return conditioning(model.unloaded)

    at = jnp.array([0.15, 0.25, 0.35])
    shapes = span_of(case).shapes(np.asarray(at))
    assert_allclose(condition_number(at), np.linalg.cond(shapes), rtol=1e-10)
    expected = central(condition_number, at, 1e-3)
    assert_allclose(jax.grad(condition_number)(at), expected, rtol=1e-6)


THIRD = 0.2  # m, a node of the third mode
ERRORS = [
    (loop([0.3, 0.3, 0.3]), "kind needs sensors of deflection that distinguish all 3 modes"),
    (loop([THIRD, 2 * THIRD]), "kind needs sensors of deflection that distinguish all 3 modes"),
    (loop([0.1], quantity="velocity"), "kind needs sensors of deflection; add one"),
    (
        jb.replace(loop([THIRD, 2 * THIRD], Kalman(1e-2, 1e-5)), {"beam.damping_ratio": 0.0}),
        "kind needs sensors that observe every mode without damping: none of 2 observes the one at",
    ),
    (
        loop([THIRD], Observer(speed=2.0), quantity="acceleration"),
        "kind needs sensors that observe every mode: none of 1 observes the one at",
    ),
    (loop([], Kalman(1e-2, 1e-5)), "kind needs sensors; add one"),
    (loop([0.1], Kalman(1e-2)), "measurement_noise must be given, as sensors.0 has no noise"),
    (loop([0.1], Kalman([1.0, 2.0], 1e-5)), "process_noise must be one number or 3, not 2"),
    (loop([0.1], Kalman(1e-2, [1.0, 2.0])), "measurement_noise must be one number or 1, not 2"),
    (loop([0.1], Kalman(-1e-2, 1e-5)), "process_noise must be positive"),
    (loop([0.1], Kalman(1e-2, 1e-5, loads="known")), "loads must be 'ignored': there are none"),
    (
        loop([0.1], Kalman(1e-2, 1e-5, weight_deviation=1.0)),
        "weight_deviation and loads = 'estimated' belong together",
    ),
]


@pytest.mark.parametrize(("case", "message"), ERRORS)
def test_errors_of_sets_of_sensors(case, message):
    with pytest.raises(ValueError, match=f"^controller.estimator.{message}"):
        check_case(case)


def test_sensors_near_a_node_warn():
    case = loop([THIRD + 2e-4, 2 * THIRD, 0.1995])
    with pytest.warns(
        ConditioningWarning, match="modes are ill-conditioned at the sensors of deflection"
    ):
        check_case(case)


def test_sensors_on_nodes_of_modes_outside_the_design():
    """No error and no warning; case files keep the estimator."""
    case = loop([THIRD, 2 * THIRD], Kalman(1e-2, 1e-5), design=DesignModel(modes=2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_case(case)
    restored = case_from_dict(case_to_dict(case))
    assert case_to_dict(restored) == case_to_dict(case)
    assert case_to_dict(case)["controller"]["estimator"]["kind"] == "kalman"

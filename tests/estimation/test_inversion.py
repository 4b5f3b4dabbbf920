"""Inversion of mode shapes against numpy and scipy; what is said of sets of sensors."""

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
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.modes import mesh_layout
from tests.differences import central
from tests.loop_as_oracle import span_of

PERIOD = 2e-3


def loop(places, estimator=None, modes=3, quantity="deflection", design=None):
    count = modes if design is None or design.modes is None else design.modes
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=modes),
        actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
        sensors=[jb.Sensor(x, quantity, offset=1e-4) for x in places],
        controller=jb.StateFeedback(
            np.zeros((1, 2 * count + 1)),
            period=PERIOD,
            delay=5e-4,
            estimator=Inversion(time_constant=0.01) if estimator is None else estimator,
            design=design,
        ),
    )


def estimates(case, readings, commands):
    """States (tick, state) found from readings and commands (tick, ...)."""
    inversion, layout = case.controller.estimator, mesh_layout(case)

    @jax.jit
    def run(case):
        model = jb.state_space(case, layout=layout)

        def tick(memory, at):
            measurement = Measurement(at[0], jnp.zeros(0), at[1])
            estimate, memory = inversion.step(memory, measurement, jnp.zeros(()))
            return memory, estimate.state

        signals = jnp.asarray(readings), jnp.asarray(commands)
        return jax.lax.scan(tick, inversion.init(model), signals)[1]

    return np.asarray(run(case))


@pytest.mark.parametrize(
    "places", [[0.15, 0.25, 0.35], [0.1, 0.2, 0.3, 0.45, 0.5], [0.15, 0.25]], ids=len
)
def test_coordinates_rates_and_states_of_actuators(places):
    """Exact, least squares or least norm; rates by scipy's filter of the differences."""
    case = loop(places)
    random = np.random.default_rng(len(places))
    readings = 1e-3 * random.normal(size=(40, len(places))) + 1e-4
    commands = random.normal(size=(40, 1))
    found = estimates(case, readings, commands)
    rows = span_of(case).shapes(np.array(places))
    modal = np.linalg.lstsq(rows, (readings - 1e-4).T, rcond=None)[0].T
    assert_allclose(found[:, :3], modal, rtol=1e-9, atol=1e-12)
    lag = np.exp(-PERIOD / 0.01)
    numerator = (1 - lag) / PERIOD * np.array([1.0, -1.0])
    rates = scipy.signal.lfilter(numerator, [1.0, -lag], modal, axis=0)
    assert_allclose(found[:, 3:6], rates, rtol=1e-9, atol=1e-9)
    # The shaker's lag: the command before acts for 0.5 ms, then that which acts at the tick.
    own, before = 0.0, 0.0
    for now, state in zip(commands[:, 0], found[:, 6], strict=True):
        own = before + (own - before) * np.exp(-400.0 * 5e-4)
        own = now + (own - now) * np.exp(-400.0 * (PERIOD - 5e-4))
        assert state == pytest.approx(own, rel=1e-9)
        before = now


def test_conditioning():
    """The ratio of singular values; where it grows, sensors may be moved down its gradient."""
    case = loop([0.15, 0.25, 0.35])

    @jax.jit
    def worst(places):
        moved = {f"sensors.{i}.position": places[i] for i in range(3)}
        model = jb.state_space(jb.replace(case, moved), layout=mesh_layout(case))
        return conditioning(model.unloaded)

    places = jnp.array([0.15, 0.25, 0.35])
    shapes = span_of(case).shapes(np.asarray(places))
    assert_allclose(worst(places), np.linalg.cond(shapes), rtol=1e-10)
    assert_allclose(jax.grad(worst)(places), central(worst, places, 1e-3), rtol=1e-6)


THIRD = 0.2  # a node of the third mode, on the span of 0.6 m
NODES = [
    (loop([0.3, 0.3, 0.3]), "kind needs sensors of deflection that tell all 3 modes apart"),
    (loop([THIRD, 2 * THIRD]), "kind needs sensors of deflection that tell all 3 modes apart"),
    (loop([0.1], quantity="velocity"), "kind needs sensors of deflection; add one"),
    (
        loop([THIRD, 2 * THIRD], Kalman(1e-2, 1e-5)),
        "kind needs sensors that see every mode: none of 2 tells the one at",
    ),
    (
        loop([THIRD], Observer(speed=2.0), quantity="acceleration"),
        "kind needs sensors that see every mode: none of 1 tells the one at",
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


@pytest.mark.parametrize(("case", "message"), NODES)
def test_sets_of_sensors_that_will_not_do_are_refused(case, message):
    with pytest.raises(ValueError, match=f"^controller.estimator.{message}"):
        check_case(case)


def test_sensors_near_a_node_are_warned_about():
    case = loop([THIRD + 2e-4, 2 * THIRD, 0.1995])
    with pytest.warns(ConditioningWarning, match="hardly tell some modes apart: errors of"):
        check_case(case)


def test_a_design_of_fewer_modes_asks_less_of_the_sensors():
    """Nodes of a mode that is not modelled do no harm; and case files hold estimators."""
    case = loop([THIRD, 2 * THIRD], Kalman(1e-2, 1e-5), design=DesignModel(modes=2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_case(case)
    again = case_from_dict(case_to_dict(case))
    assert case_to_dict(again) == case_to_dict(case)
    assert case_to_dict(case)["controller"]["estimator"]["kind"] == "kalman"

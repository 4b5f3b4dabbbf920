"""Commands of predictive control, sample by sample, against an independent quadratic program.

Along a crossing, with two actuators and two positions: predictions by scipy's integration of the
plant with the mass on its way, moves by Clarabel. A millionth of the range of 10 V is allowed.
"""

import functools

import clarabel
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
import scipy.sparse
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from tests.loop_as_oracle import span_of
from tests.oracles.sampled_plant import over_period

PERIOD, LIMITS, RATE = 0.01, (-4.0, 6.0), 250.0
STARTS, MOMENT, POSITIONS, MASS, SPEED = (0.15, 0.4), 0.1, (0.15, 0.4), 0.4, 2.0
SAMPLES, ENTRY = 6, 0.0123  # s: between two samples
BASE = {"horizon": 5, "moves": 3, "move_weight": [1e-10, 3e-10], "positions": POSITIONS}
TIME_VARYING = {"loads": "known", "prediction": "time-varying"}
SETTINGS = {
    "time-varying, without limits": TIME_VARYING | {"solver": "unconstrained"},
    "time-varying, within limits and rates": TIME_VARYING,
    "a fast mass": TIME_VARYING | {"speed": 10.0},
    "the weight of a fast load": {"loads": "known", "speed": 10.0},
    "masses without weights": {"prediction": "time-varying"},
    "weights of outputs and periods": {
        "output_weight": [1.0, 0.2],
        "horizon_weight": [1.0, 0.5, 2.0, 1.0, 3.0],
    },
    "soft limits": {"soft_limit": [2e-4, 4e-4], "soft_weight": 30.0, "move_weight": 1e-9},
    "hard limits": {"hard_limit": [9e-4, 9.5e-4], "move_weight": 1e-8},
    "hard and soft limits": {
        "hard_limit": 9e-4,
        "soft_limit": 3e-4,
        "soft_weight": 0.3,
        "move_weight": 1e-8,
    },
    "Laguerre functions": {"horizon": 8, "moves": 2, "laguerre_pole": 0.6} | TIME_VARYING,
    "terminal cost": {"terminal": "riccati"},
}
DRAWS = np.random.default_rng(5).normal(size=(SAMPLES, 4))
STATES = DRAWS * np.array([2e-4, 3e-5, 1e-2, 5e-3]) - np.array([1.5e-4, 0, 0, 0])


def beam_case(speed=SPEED, **settings) -> jb.Case:
    actuators = [
        jb.Patch(x, x + 0.05, MOMENT, limits=list(LIMITS), rate_limit=RATE) for x in STARTS
    ]
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=actuators,
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=MASS, speed=speed, entry_time=ENTRY)],
        controller=jb.MPC(**(BASE | {"period": PERIOD} | settings)),
        run=jb.Run(0.4),
    )


def matrices(span, t, mass, speed):
    """A, and B with a column for the weight, at t (s)."""
    n, on = span.modes, ENTRY <= t < ENTRY + span.length / speed
    x = speed * (t - ENTRY)
    under, slope, curvature = (span.shapes(x, d) if on else np.zeros(n) for d in range(3))
    stiffness = np.diag(span.frequencies**2) + mass * speed**2 * np.outer(under, curvature)
    damping = span.damping + 2 * mass * speed * np.outer(under, slope)
    compliance = np.linalg.inv(np.eye(n) + mass * np.outer(under, under))
    state_matrix = np.vstack([np.eye(n, 2 * n, k=n), -compliance @ np.hstack([stiffness, damping])])
    forces = [MOMENT * (span.shapes(x, 1) - span.shapes(x + 0.05, 1)) for x in STARTS] + [-under]
    return state_matrix, np.vstack([np.zeros((n, 3)), compliance @ np.array(forces).T])


@functools.cache
def plant(period, mass, speed):
    """A, B, E over a period, by scipy; its number counts from t = 0, None is without the load."""
    span = span_of(beam_case())
    start = -1e3 if period is None else period * PERIOD
    events = ENTRY, ENTRY + span.length / speed
    A, B = over_period(lambda t: matrices(span, t, mass, speed), start, start + PERIOD, events)
    return A, B[:, :2], B[:, 2]


def sequences(law) -> np.ndarray:
    """Basis of the moves (period, term) of an actuator; Laguerre functions by chained filters."""
    if law.laguerre_pole is None:
        return np.eye(law.horizon, law.moves)
    pole, pulse = float(law.laguerre_pole), np.eye(law.horizon)[0]
    found = [scipy.signal.lfilter([np.sqrt(1 - pole**2)], [1, -pole], pulse)]
    for _ in range(law.moves - 1):
        found.append(scipy.signal.lfilter([-pole, 1], [1, -pole], found[-1]))
    return np.array(found).T


class ExplicitProgram:
    """Program of a sample: sum of squares of affine functions of the variables, and limits."""

    def __init__(self, law, plants, weight, state, unexplained, previous, C):
        self.law, self.plants, self.weight, self.C = law, plants, weight, C
        self.state, self.unexplained, self.previous = state, unexplained, previous
        self.shapes = sequences(law)

    def future(self, variables):
        """Moves (period, actuator), commands, and states, for variables (term, actuator)."""
        moves = self.shapes @ variables.reshape(-1, 2)
        commands = self.previous + np.cumsum(moves, axis=0)
        states = [self.state]
        for (A, B, E), command in zip(self.plants, commands, strict=True):
            states.append(A @ states[-1] + B @ command + E * self.weight + self.unexplained)
        return moves, commands, np.array(states)

    def residuals(self, variables):
        """Terms whose squares are the cost, in units in which they are some thousands."""
        moves, _, states = self.future(variables)
        law, outputs = self.law, states[1:] @ self.C.T
        period_weights = np.ones(law.horizon) if law.horizon_weight is None else law.horizon_weight
        output_weights = np.ones(2) if law.output_weight is None else law.output_weight
        weight = np.outer(period_weights, output_weights)
        parts = [np.sqrt(np.broadcast_to(law.move_weight, 2)) * moves]
        if law.terminal == "riccati":
            A, B, _ = self.plants[0]
            A_incremental = np.block([[A, np.zeros((4, 2))], [self.C @ A, np.eye(2)]])
            B_incremental, Q = np.vstack([B, self.C @ B]), np.diag([0.0] * 4 + [1.0] * 2)
            R = np.diag(np.broadcast_to(law.move_weight, 2))
            # In micrometres, in which the equation is better conditioned.
            P = (
                scipy.linalg.solve_discrete_are(A_incremental, B_incremental, 1e12 * Q, 1e12 * R)
                / 1e12
            )
            values, vectors = np.linalg.eigh((P + P.T) / 2)
            root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
            parts.append(root @ np.append(states[-1] - states[-2], outputs[-1]))
            weight[-1] = 0
        parts.append(np.sqrt(weight) * outputs)
        return 1e6 * np.concatenate([part.ravel() for part in parts])

    def rows(self, variables):
        """Constraint functions, which must not be positive."""
        moves, commands, _ = self.future(variables)
        last = self.law.horizon if self.law.laguerre_pole is not None else self.law.moves
        moves, commands = moves[:last], commands[:last]
        bounds = (commands - LIMITS[1], LIMITS[0] - commands, moves - 2.5, -moves - 2.5)
        return np.concatenate([part.ravel() for part in bounds])

    def solve(self):
        """First command."""
        count = 2 * self.shapes.shape[1]
        residuals, slopes = affine(self.residuals, count)
        if self.law.solver == "unconstrained":
            best = np.linalg.lstsq(slopes, -residuals)[0]
            return self.future(best)[1][0]
        rows, row_slopes = affine(self.rows, count)
        outputs, output_slopes = affine(lambda v: 1e6 * self.future(v)[2][1:] @ self.C.T, count)
        output_slopes = output_slopes.reshape(-1, count)
        if self.law.hard_limit is not None:  # in um
            allowed = 1e6 * np.broadcast_to(self.law.hard_limit, outputs.shape)
            rows = np.concatenate([rows, (outputs - allowed).ravel(), (-outputs - allowed).ravel()])
            row_slopes = np.vstack([row_slopes, output_slopes, -output_slopes])
        if self.law.soft_limit is not None:  # an excess (um) for each position, and its cost
            extra = 1e6 * np.sqrt(float(self.law.soft_weight)) * 1e-6 * np.eye(2)
            slopes = scipy.linalg.block_diag(slopes, extra)
            residuals = np.append(residuals, np.zeros(2))
            allowed = 1e6 * np.broadcast_to(self.law.soft_limit, outputs.shape)
            excess = np.tile(np.eye(2), (len(outputs), 1))
            row_slopes = np.vstack(
                [
                    np.hstack([row_slopes, np.zeros((len(row_slopes), 2))]),
                    np.hstack([output_slopes, -excess]),
                    np.hstack([-output_slopes, -excess]),
                ]
            )
            rows = np.concatenate([rows, (outputs - allowed).ravel(), (-outputs - allowed).ravel()])
        best = by_clarabel(2 * slopes.T @ slopes, 2 * slopes.T @ residuals, row_slopes, -rows)
        return self.future(best[:count])[1][0]


def affine(function, count):
    """Value at zero, and derivatives by the variables (..., variable)."""
    start = function(np.zeros(count))
    return start, np.stack(
        [function(unit_vector) - start for unit_vector in np.eye(count)], axis=-1
    )


def by_clarabel(H, f, M, gamma):
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    sparse, cones = scipy.sparse.csc_matrix, [clarabel.NonnegativeConeT(gamma.size)]
    size = np.max(np.abs(H))
    upper = scipy.sparse.triu(sparse(H / size), format="csc")
    solver = clarabel.DefaultSolver(upper, f / size, sparse(M), gamma, cones, settings)
    return np.array(solver.solve().x)


def commands_of(case) -> np.ndarray:
    """Commands (sample, actuator) of the law for STATES while the load crosses."""

    @eqx.filter_jit
    def run(model):
        law = case.controller.law(model)

        def step(carry, sample):
            command, law_state = carry
            state, t = sample
            measurement = Measurement(jnp.zeros(1), state, command)
            command, law_state, _ = law.step(law_state, measurement, t)
            return (command, law_state), command

        start = jnp.zeros(2), law.initial_state()
        times = jnp.arange(SAMPLES) * PERIOD
        return jax.lax.scan(step, start, (jnp.asarray(STATES), times))[1]

    return np.asarray(run(jb.state_space(case)))


@pytest.mark.parametrize("name", SETTINGS)
def test_commands_against_an_independent_program(name):
    case = beam_case(**SETTINGS[name])
    law, span, found = case.controller, span_of(case), commands_of(case)
    speed = SETTINGS[name].get("speed", SPEED)
    varying = law.prediction == "time-varying"
    mass = MASS if varying else 0.0
    weight = MASS * 9.81 if law.loads == "known" else 0.0
    C = np.array([np.append(span.shapes(x), np.zeros(2)) for x in POSITIONS])
    past, previous = np.zeros(4), np.zeros(2)
    for k, state in enumerate(STATES):
        periods = range(k - 1, k + law.horizon)
        (A, B, E), *plants = [plant(i if varying or weight else None, mass, speed) for i in periods]
        unexplained = state - (A @ past + B @ previous + E * weight)
        program = ExplicitProgram(law, plants, weight, state, unexplained, previous, C)
        assert_allclose(found[k], program.solve(), rtol=0, atol=1e-6 * (LIMITS[1] - LIMITS[0]))
        past, previous = state, found[k]
    if law.solver != "unconstrained":
        active = np.abs(np.diff(found, axis=0, prepend=0.0)) > 2.5 - 1e-6
        active |= (found > LIMITS[1] - 1e-6) | (found < LIMITS[0] + 1e-6)
        assert 0 < np.mean(active) < 1, "some limits and rate limits must be active, not all"
    if law.soft_limit is not None:
        without = commands_of(beam_case(**SETTINGS[name] | {"soft_limit": 1.0}))
        assert np.max(np.abs(found - without)) > 0.05
    if law.hard_limit is not None:
        without = commands_of(beam_case(**SETTINGS[name] | {"hard_limit": 1.0}))
        assert np.max(np.abs(found - without)) > 0.05


def test_the_last_command_is_held_where_no_commands_keep_a_hard_limit():
    assert_allclose(commands_of(beam_case(hard_limit=1e-7)), 0.0, atol=1e-12)

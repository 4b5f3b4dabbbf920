"""Commands of predictive control, tick by tick, against the program written out, solved by others.

Along a crossing, with two actuators and two places: what is predicted follows period by period from
matrices of numpy's, the moves from Clarabel.
"""

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

PERIOD, LIMITS, RATE = 0.01, (-4.0, 6.0), 250.0
STARTS, MOMENT, PLACES, MASS, SPEED = (0.15, 0.4), 0.1, (0.15, 0.4), 0.4, 2.0
TICKS = 6
BASE = {"horizon": 5, "moves": 3, "move_weight": [1e-10, 3e-10], "places": PLACES}
KNOWING = {"loads": "known", "prediction": "time-varying"}
SETTINGS = {
    "time-varying, without limits": KNOWING | {"solver": "unconstrained"},
    "time-varying, within limits and rates": KNOWING,
    "masses known, weights not": {"prediction": "time-varying"},
    "weights of outputs and periods": {
        "output_weight": [1.0, 0.2],
        "horizon_weight": [1.0, 0.5, 2.0, 1.0, 3.0],
    },
    "soft limits": {"soft_limit": [2e-4, 4e-4], "soft_weight": 30.0, "move_weight": 1e-9},
    "Laguerre functions": {"horizon": 8, "moves": 2, "laguerre_pole": 0.6} | KNOWING,
    "terminal cost": {"terminal": "riccati"},
}
DRAWS = np.random.default_rng(5).normal(size=(TICKS, 4))
STATES = DRAWS * np.array([2e-4, 3e-5, 1e-2, 5e-3]) - np.array([1.5e-4, 0, 0, 0])


def rig(**settings) -> jb.Case:
    actuators = [
        jb.Patch(x, x + 0.05, MOMENT, limits=list(LIMITS), rate_limit=RATE) for x in STARTS
    ]
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=actuators,
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=MASS, speed=SPEED, entry_time=0.02)],
        controller=jb.MPC(**(BASE | {"period": PERIOD} | settings)),
        run=jb.Run(0.4),
    )


def plant(span, t, mass):
    """A, B, E of a period, the load frozen at its place at t (s); exponentials by scipy."""
    n, on = span.modes, 0.02 <= t < 0.02 + span.length / SPEED
    x = SPEED * (t - 0.02)
    under, slope, curvature = (span.shapes(x, d) if on else np.zeros(n) for d in range(3))
    stiffness = np.diag(span.frequencies**2) + mass * SPEED**2 * np.outer(under, curvature)
    damping = span.damping + 2 * mass * SPEED * np.outer(under, slope)
    moved = np.linalg.inv(np.eye(n) + mass * np.outer(under, under))
    drift = np.vstack([np.eye(n, 2 * n, k=n), -moved @ np.hstack([stiffness, damping])])
    pushes = [MOMENT * (span.shapes(x, 1) - span.shapes(x + 0.05, 1)) for x in STARTS] + [-under]
    inputs = np.vstack([np.zeros((n, 3)), moved @ np.array(pushes).T])
    whole = scipy.linalg.expm(PERIOD * np.vstack([np.hstack([drift, inputs]), np.zeros((3, 7))]))
    return whole[:4, :4], whole[:4, 4:6], whole[:4, 6]


def sequences(law) -> np.ndarray:
    """Moves (period, variable) that an actuator may make; Laguerre's by a chain of filters."""
    if law.laguerre_pole is None:
        return np.eye(law.horizon, law.moves)
    pole, pulse = float(law.laguerre_pole), np.eye(law.horizon)[0]
    found = [scipy.signal.lfilter([np.sqrt(1 - pole**2)], [1, -pole], pulse)]
    for _ in range(law.moves - 1):
        found.append(scipy.signal.lfilter([-pole, 1], [1, -pole], found[-1]))
    return np.array(found).T


class Program:
    """What a tick asks for: costs as squares of what is linear in the variables, and limits."""

    def __init__(self, law, plants, weight, state, rest, before, C):
        self.law, self.plants, self.weight = law, plants, weight
        self.state, self.rest, self.before, self.C = state, rest, before, C
        self.shapes = sequences(law)

    def future(self, variables):
        """Moves (period, actuator), commands, states from now on, by variables (term, actuator)."""
        moves = self.shapes @ variables.reshape(-1, 2)
        commands = self.before + np.cumsum(moves, axis=0)
        states = [self.state]
        for (A, B, E), command in zip(self.plants, commands, strict=True):
            states.append(A @ states[-1] + B @ command + E * self.weight + self.rest)
        return moves, commands, np.array(states)

    def squares(self, variables):
        """What is squared and added up; in units that make it some thousands."""
        moves, _, states = self.future(variables)
        law, outputs = self.law, states[1:] @ self.C.T
        ahead = np.ones(law.horizon) if law.horizon_weight is None else law.horizon_weight
        each = np.ones(2) if law.output_weight is None else law.output_weight
        weight = np.outer(ahead, each)
        parts = [np.sqrt(np.broadcast_to(law.move_weight, 2)) * moves]
        if law.terminal == "riccati":
            A, B, _ = self.plants[0]
            wide = np.block([[A, np.zeros((4, 2))], [self.C @ A, np.eye(2)]])
            push, seen = np.vstack([B, self.C @ B]), np.diag([0.0] * 4 + [1.0] * 2)
            price = np.diag(np.broadcast_to(law.move_weight, 2))
            # In micrometres, which is kinder to the solver.
            P = scipy.linalg.solve_discrete_are(wide, push, 1e12 * seen, 1e12 * price) / 1e12
            values, vectors = np.linalg.eigh((P + P.T) / 2)
            root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
            parts.append(root @ np.append(states[-1] - states[-2], outputs[-1]))
            weight[-1] = 0
        parts.append(np.sqrt(weight) * outputs)
        return 1e6 * np.concatenate([part.ravel() for part in parts])

    def rows(self, variables):
        """What must not be positive."""
        moves, commands, _ = self.future(variables)
        last = self.law.horizon if self.law.laguerre_pole is not None else self.law.moves
        moves, commands = moves[:last], commands[:last]
        bounds = (commands - LIMITS[1], LIMITS[0] - commands, moves - 2.5, -moves - 2.5)
        return np.concatenate([part.ravel() for part in bounds])

    def solve(self):
        """The first command."""
        count = 2 * self.shapes.shape[1]
        squares, slopes = affine(self.squares, count)
        if self.law.solver == "unconstrained":
            best = np.linalg.lstsq(slopes, -squares)[0]
            return self.future(best)[1][0]
        rows, tilts = affine(self.rows, count)
        if self.law.soft_limit is not None:  # an excess (um) for each place, and its price
            extra = 1e6 * np.sqrt(float(self.law.soft_weight)) * 1e-6 * np.eye(2)
            slopes = scipy.linalg.block_diag(slopes, extra)
            squares = np.append(squares, np.zeros(2))
            seen, bent = affine(lambda v: 1e6 * self.future(v)[2][1:] @ self.C.T, count)
            allowed = 1e6 * np.broadcast_to(self.law.soft_limit, seen.shape)
            bent, excess = bent.reshape(-1, count), np.tile(np.eye(2), (len(seen), 1))
            tilts = np.vstack(
                [
                    np.hstack([tilts, np.zeros((len(tilts), 2))]),
                    np.hstack([bent, -excess]),
                    np.hstack([-bent, -excess]),
                ]
            )
            rows = np.concatenate([rows, (seen - allowed).ravel(), (-seen - allowed).ravel()])
        best = by_clarabel(2 * slopes.T @ slopes, 2 * slopes.T @ squares, tilts, -rows)
        return self.future(best[:count])[1][0]


def affine(function, count):
    """Value at zero, and slopes by each of the variables (..., variable)."""
    start = function(np.zeros(count))
    return start, np.stack([function(one) - start for one in np.eye(count)], axis=-1)


def by_clarabel(H, f, M, gamma):
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    sparse, cones = scipy.sparse.csc_matrix, [clarabel.NonnegativeConeT(gamma.size)]
    size = np.max(np.abs(H))
    upper = scipy.sparse.triu(sparse(H / size), format="csc")
    solver = clarabel.DefaultSolver(upper, f / size, sparse(M), gamma, cones, settings)
    return np.array(solver.solve().x)


def asked(case) -> np.ndarray:
    """Commands (tick, actuator) that the law gives to some states, the load on its way."""

    @eqx.filter_jit
    def run(model):
        def tick(carry, at):
            given, memory = carry
            state, t = at
            seen = Measurement(jnp.zeros(1), state, given)
            given, memory = case.controller.step(memory, seen, t)
            return (given, memory), given

        start = jnp.zeros(2), case.controller.init(model)
        times = jnp.arange(TICKS) * PERIOD
        return jax.lax.scan(tick, start, (jnp.asarray(STATES), times))[1]

    return np.asarray(run(jb.state_space(case)))


@pytest.mark.parametrize("name", SETTINGS)
def test_commands_are_those_of_the_program_written_out(name):
    case = rig(**SETTINGS[name])
    law, span, found = case.controller, span_of(case), asked(case)
    varying = law.prediction == "time-varying"
    mass = MASS if varying else 0.0
    weight = MASS * 9.81 if law.loads == "known" else 0.0
    C = np.array([np.append(span.shapes(x), np.zeros(2)) for x in PLACES])
    past, given = np.zeros(4), np.zeros(2)
    for k, state in enumerate(STATES):
        middles = (k + np.arange(-1, law.horizon) + 0.5) * PERIOD
        times = middles if varying or weight else np.full(middles.shape, -1.0)
        (A, B, E), *plants = [plant(span, t, mass) for t in times]
        rest = state - (A @ past + B @ given + E * weight)
        wanted = Program(law, plants, weight, state, rest, given, C).solve()
        assert_allclose(found[k], wanted, rtol=0, atol=1e-6)
        past, given = state, found[k]
    if law.solver != "unconstrained":
        felt = np.abs(np.diff(found, axis=0, prepend=0.0)) > 2.5 - 1e-6
        felt |= (found > LIMITS[1] - 1e-6) | (found < LIMITS[0] + 1e-6)
        assert 0 < np.mean(felt) < 1, "limits and rates must be felt at times"
    if law.soft_limit is not None:
        firm = asked(rig(**SETTINGS[name] | {"soft_limit": 1.0}))
        assert np.max(np.abs(found - firm)) > 0.05

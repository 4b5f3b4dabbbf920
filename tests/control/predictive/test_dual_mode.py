"""Dual-mode predictive control: its terminal set and cost against scipy's regulator and motions."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Estimate, Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.mpc import TerminalSetWarning
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.qp import solve_qp
from tests.differences import central

PERIOD, POSITIONS, MOVE_WEIGHT = 0.01, [0.2, 0.3, 0.45], 1e-9
LIMITS, RATE, HARD = (-3.0, 5.0), 250.0, 6e-4
SETTINGS = {
    "horizon": 4,
    "moves": 4,
    "move_weight": MOVE_WEIGHT,
    "period": PERIOD,
    "positions": POSITIONS,
    "terminal": "dual-mode",
}
KINDS = {
    "limits of commands": {},
    "deflections, too": {"hard_limit": HARD},
    "late commands": {"delay": 0.004},
}
RNG = np.random.default_rng(3)


def dual_case(modes=2, actuator=None, **settings) -> jb.Case:
    """One actuator, one sensor, and deflections controlled at three positions."""
    if actuator is None:
        actuator = jb.Patch(0.15, 0.2, 0.1, limits=list(LIMITS), rate_limit=RATE)
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=modes),
        actuators=[actuator],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.4, speed=2.0)],
        controller=jb.MPC(**(SETTINGS | settings)),
        run=jb.Run(0.5),
    )


@functools.cache
def law_of(name, **settings):
    case = dual_case(**KINDS[name], **settings)
    return case.controller.law(jb.state_space(case)).law


class Regulated:
    """Unloaded plant in the states (x, u(k-1)) and its regulator, by scipy."""

    def __init__(self, **settings):
        plant = jb.state_space(dual_case()).unloaded
        A, B = (np.asarray(part) for part in (plant.A, plant.B))
        rows = np.zeros((3, 4))
        shapes = np.sin(np.pi * np.outer(POSITIONS, [1, 2]) / 0.6) * np.sqrt(2 / (0.535 * 0.6))
        rows[:, :2] = shapes
        delay = settings.get("delay", 0.0)

        def held(span):
            return scipy.signal.cont2discrete((A, B, rows, np.zeros((3, 1))), span)[:2]

        self.A, whole = held(PERIOD)
        self.late = held(PERIOD - delay)[1]
        self.early = whole - self.late
        column = whole[:, 0]
        augmented = np.block([[self.A, column[:, None]], [np.zeros((1, 4)), np.ones((1, 1))]])
        moves = np.append(self.late, 1.0)[:, None]
        self.C, self.limit = np.hstack([rows, np.zeros((3, 1))]), settings.get("hard_limit")
        Q = 1e12 * self.C.T @ self.C
        self.P = scipy.linalg.solve_discrete_are(augmented, moves, Q, [[1e12 * MOVE_WEIGHT]])
        self.gain = np.linalg.solve(
            1e12 * MOVE_WEIGHT + moves.T @ self.P @ moves, moves.T @ self.P @ augmented
        )
        self.loop, self.P = augmented - moves @ self.gain, self.P / 1e12

    def worst(self, start, periods=300):
        """Largest share of a limit along the motion of the regulator from z = (x, u(k-1))."""
        z, shares = start, []
        for _ in range(periods):
            move, z = -self.gain @ z, self.loop @ z
            shares += [z[-1] / LIMITS[1], z[-1] / LIMITS[0], np.abs(move[0]) / (RATE * PERIOD)]
            if self.limit is not None:
                shares.append(np.max(np.abs(self.C @ z)) / self.limit)
        return max(shares)


@pytest.mark.parametrize("name", KINDS)
def test_terminal_set_is_all_from_where_the_regulator_keeps_its_limits(name):
    """On random rays both the limits and the rows are met up to the same distance."""
    regulated, terminal = Regulated(**KINDS[name]), law_of(name).terminal
    for direction in RNG.normal(size=(20, 5)) * [1e-4, 1e-4, 1e-2, 1e-2, 1.0]:
        assert_allclose(np.max(terminal.rows @ direction), regulated.worst(direction), rtol=1e-7)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("horizon", [1, 4])
def test_first_command_is_that_of_the_regulator_where_no_limit_is_near(name, horizon):
    """At any horizon, also where a soft set is asked for."""
    regulated = Regulated(**KINDS[name])
    for weight in (None, 1e5):
        sizes = {"horizon": horizon, "moves": horizon, "terminal_weight": weight}
        law = law_of(name, **sizes)
        x, command = RNG.normal(size=4) * [1e-6, 1e-6, 1e-4, 1e-4], np.array([0.02])
        before = np.linalg.solve(regulated.A, x - (regulated.early + regulated.late) @ command)
        memory = np.append(before, command) if law.delayed else before
        step = law.step(memory, Estimate(x), Measurement(np.zeros(1), x, command), np.zeros(()))
        expected = command - regulated.gain @ np.append(x, command)
        assert step.solved
        assert_allclose(step.command, expected, rtol=1e-6)


def solution(law, x, command):
    """Moves of the program of a state that the model explains, and whether they exist."""
    state = np.append(x, command) if law.delayed else x
    initial = np.concatenate([state, np.zeros_like(state), command, [1.0]])
    found = solve_qp(*law.quadratic_program(law.prediction, initial, command))
    return found.x, bool(found.solved)


@pytest.mark.parametrize("name", KINDS)
def test_problems_stay_solvable_and_the_cost_decreases(name):
    """From states at the edge of what is feasible, by at least what the sample costs."""
    regulated, law = Regulated(**KINDS[name]), law_of(name)

    def advance(x, previous, command):
        return regulated.A @ x + regulated.early @ previous + regulated.late @ command

    def cost(x, command, moves):
        total = 0.0
        for move in moves:
            previous, command = command, command + move
            x = advance(x, previous, command)
            total += np.sum((regulated.C[:, :4] @ x) ** 2) + MOVE_WEIGHT * move**2
        z = np.append(x, command)
        return float(np.sum(total) + z @ regulated.P @ z - np.sum((regulated.C @ z) ** 2))

    active = 0
    for direction in RNG.normal(size=(3, 4)) * [1e-4, 1e-4, 1e-2, 1e-2]:
        x, command = edge_of_feasible(law, direction), np.zeros(1)
        before = np.inf
        for _ in range(12):
            moves, solved = solution(law, x, command)
            assert solved
            after = cost(x, command, moves[:4])
            assert after <= before * (1 + 1e-9) + 1e-14
            active += np.isclose(command[0] + moves[0], LIMITS).any()
            active += np.isclose(abs(moves[0]), RATE * PERIOD)
            previous, command = command, command + moves[:1]
            x = advance(x, previous, command)
            sample = np.sum((regulated.C[:, :4] @ x) ** 2) + MOVE_WEIGHT * moves[0] ** 2
            before = after - sample
    assert active > 0


def edge_of_feasible(law, direction):
    """State on a ray beyond which, by a percent, the program has no solution."""
    low, high = 0.0, 1.0
    while solution(law, high * direction, np.zeros(1))[1]:
        low, high = high, 2 * high
    while high - low > 0.01 * high:
        middle = (low + high) / 2
        solved = solution(law, middle * direction, np.zeros(1))[1]
        low, high = (middle, high) if solved else (low, middle)
    return low * direction


def test_soft_set_is_left_only_where_it_cannot_be_reached():
    hard, soft = (law_of("limits of commands", terminal_weight=weight) for weight in (None, 1e5))
    direction, none = np.array([1e-4, -2e-5, 1e-3, 2e-3]), np.zeros(1)
    edge = edge_of_feasible(hard, direction)
    within, without = solution(hard, edge, none)[0], law_of("limits of commands")
    assert_allclose(solution(soft, edge, none)[0][:4], within, atol=1e-7)
    free = without.quadratic_program(
        without.prediction, np.concatenate([edge, np.zeros(5), [1.0]]), none
    )
    assert np.max(np.abs(within - np.linalg.solve(free.H, -free.f))) > 0.1  # V
    beyond = solution(soft, 1.5 * edge, none)
    assert beyond[1] and beyond[0][-1] > 1e-3
    assert not solution(hard, 1.5 * edge, none)[1]


@pytest.mark.parametrize("name", KINDS)
def test_weights_are_relative_to_the_least_cost_of_a_state_at_a_limit(name):
    """By scipy's regulator: no state at a limit of its motion costs less, and one costs that."""
    regulated, terminal = Regulated(**KINDS[name]), law_of(name, terminal_weight=2.0).terminal
    scale = terminal.weight / 2
    directions = RNG.normal(size=(300, 5)) @ np.linalg.cholesky(np.linalg.inv(regulated.P)).T
    at_limits = directions / [[regulated.worst(z, 30)] for z in directions]
    costs = np.einsum("ri,ij,rj->r", at_limits, regulated.P, at_limits)
    assert scale <= np.min(costs) * (1 + 1e-6)
    nearest = np.linalg.solve(regulated.P, np.asarray(terminal.rows).T).T
    nearest = nearest / [[regulated.worst(z, 30)] for z in nearest]
    costs = np.einsum("ri,ij,rj->r", nearest, regulated.P, nearest)
    assert_allclose(np.min(costs), scale, rtol=1e-6)


@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_recommended_weights_do_not_raise_the_peak(weight):
    """Under a mass for which the set is out of reach."""
    peaks = {
        name: np.max(jb.simulate(dual_case(**settings)).peak_deflection)
        for name, settings in {
            "none": {"terminal": "none"},
            "soft": {"terminal_weight": weight},
        }.items()
    }
    assert peaks["soft"] < 1.005 * peaks["none"]


@pytest.mark.parametrize("weight", [None, 4.0, 300.0])
def test_sets_that_outweigh_deflections_are_warned_of(weight):
    with pytest.warns(TerminalSetWarning, match="terminal set out of reach"):
        check_case(dual_case(terminal_weight=weight))
    check_case(dataclasses.replace(dual_case(terminal_weight=weight), loads=()))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"moves": 3}, "moves must be as many as the horizon has periods"),
        ({"positions": []}, "positions must be given"),
        ({"terminal_periods": 1}, "terminal_periods must be at least"),
        ({"positions": [0.3], "terminal_weight": 1.0}, "positions must show mode 2"),
        ({"positions": [0.3], "terminal_weight": 1.0, "modes": 5}, "positions must show mode 2"),
        ({"terminal": "none", "terminal_weight": 1.0}, "terminal_weight is that of a terminal set"),
        ({"actuator": jb.PointForce(0.25, limits=[1.0, 5.0])}, "limits of actuators.0 are 1 and 5"),
    ],
)
def test_errors_of_settings(settings, words):
    with pytest.raises(ValueError, match=words):
        check_case(dual_case(**settings))


def test_run_of_a_crossing_with_three_deflections_and_one_actuator():
    """The set is soft under the load; deflection and command then go to zero."""
    record = jb.simulate(dual_case(terminal_weight=1.0, modes=1))
    assert record.failures[-1] == 0
    assert_allclose(record.command[-1], 0.0, atol=1e-2)
    assert np.max(np.abs(record.command)) > 1.0


def test_derivatives_of_commands_at_the_limits_of_the_set():
    """By weight of the moves, limits and rigidity of the beam, forward."""
    case = dual_case(modes=1, terminal_periods=12)
    layout = mesh_layout(case)
    start = case.controller.law(jb.state_space(case)).law
    x = edge_of_feasible(start, np.array([1e-4, 1e-3]))

    def first(point):
        changed = jb.replace(
            case,
            {
                "controller.move_weight": MOVE_WEIGHT * point[0],
                "actuators.0.limits": np.array(LIMITS) * point[1],
                "beam.flexural_rigidity": 11.68 * point[2],
            },
        )
        law = changed.controller.law(jb.state_space(changed, layout=layout)).law
        return solution_of(law, 0.97 * x)

    def solution_of(law, x):
        initial = np.concatenate([x, np.zeros(3), [1.0]])
        return solve_qp(*law.quadratic_program(law.prediction, initial, np.zeros(1))).x

    point = np.ones(3)
    expected = central(first, point, 1e-5)
    assert np.max(np.abs(expected)) > 0.1
    found = jax.jit(jax.jacfwd(first))(point)
    assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.max(np.abs(expected)))

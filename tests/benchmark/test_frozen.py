"""Frozen problems, certificates of their bounds against other programs, scores, the command."""

import dataclasses
import functools
import hashlib
import itertools
import json
from importlib import resources

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.benchmark import scoring
from jaxbeam.benchmark.problem import TEST_SEEDS, VERSION, load, names
from jaxbeam.benchmark.scoring import attainable, compute_attainable, published
from jaxbeam.simulation.commands import command_ranges
from jaxbeam.simulation.integrator.step_size import static_shapes
from tests.modules import ROOT

# Of all that v1 is. Numbers under it are cited: what must change is a new version beside it.
CHECKSUM = "fec1826a0ec20a1d5e4f9cc27e568ca0b0dcb25d81949966a2e70bd47d872f3e"
FROZEN = ("problems.toml", "bounds.json", "baselines.json", "problems")


def frozen_text() -> bytes:
    top = ROOT / "jaxbeam" / "benchmark"
    files = [
        path for name in FROZEN for path in ([top / name] if "." in name else top.glob(name + "/*"))
    ]
    return b"".join(path.name.encode() + path.read_bytes() for path in sorted(files))


def test_version_1_does_not_change():
    assert VERSION == "v1" and TEST_SEEDS == (1, 2, 3, 4, 5)
    assert scoring.LEAST_SHARE == -1.0
    assert hashlib.sha256(frozen_text()).hexdigest() == CHECKSUM


def test_there_are_ten_problems_with_all_that_is_published():
    assert len(names()) == 10
    assert set(jb.benchmark.baselines()) == set(names())
    for name in names():
        problem, stored = load(name), published(name)
        assert_allclose([one.load for one in stored["training"]], problem.training)
        loads = [problem.test_load(seed) for seed in TEST_SEEDS]
        assert_allclose([one.load for one in stored["test"]], loads, rtol=1e-11)
        for one in [*stored["training"], *stored["test"]]:
            assert 0 < one.bound < one.uncontrolled
            assert_allclose(np.abs(one.weights).sum(), 1, rtol=1e-6)
        duration, period = float(problem.case.run.duration), problem.period
        assert_allclose(duration / period, round(duration / period), rtol=1e-12)
        shares = np.array([problem.shares(one) for one in problem.training])
        assert np.all((shares >= -1e-12) & (shares <= 1 + 1e-12))


@pytest.mark.parametrize("name", names())
def test_no_load_has_more_wheels_on_the_beam(name):
    problem = load(name)
    corners = [problem.numbers(np.full(len(problem.vary), share)) for share in (0.0, 1.0)]
    for numbers in [*corners, *(problem.test_load(seed) for seed in range(20))]:
        shapes = static_shapes(problem.with_load(problem.case, numbers))
        assert shapes.max_loads <= problem.max_loads


def weighted_sum(problem, stored, commands) -> float:
    """Weighted sum of the deflections (m) of a run under held commands, by `simulate`."""
    times = np.arange(len(commands) + 1) * problem.period
    values = np.concatenate([commands, commands[-1:]]).T
    law = jb.Prescribed(
        offsets=np.zeros(len(values)), period=problem.period, times=times, values=values
    )
    case = dataclasses.replace(problem.run_case(stored.load), controller=law)
    deflections = np.asarray(jb.simulate(case).at(np.array(problem.positions)))
    return float(stored.weights @ deflections[tuple(stored.places)])


def held_commands(problem, draw):
    """Commands of a run within the limits and rates of the actuators, from rest."""
    low, high, rate = command_ranges(dataclasses.replace(problem.case, controller=None))
    low, high, rate = (np.asarray(part)[list(problem.driven)] for part in (low, high, rate))
    count = round(float(problem.case.run.duration) / problem.period)
    rows, last = [], np.zeros(len(low))
    for _ in range(count):
        wanted = draw(low, high)
        last = np.clip(wanted, last - rate * problem.period, last + rate * problem.period)
        rows.append(last)
    return np.array(rows)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
@pytest.mark.parametrize("name", names())
def test_the_certificate_holds_for_commands_within_the_limits(name):
    """Without any linear program: the weighted sum is at least the bound, whatever is done."""
    problem, random = load(name), np.random.default_rng(0)
    stored = published(name)["test"][0]
    for draw in (
        lambda low, high: random.uniform(low, high),
        lambda low, high: np.where(random.random(len(low)) < 0.5, low, high),
        lambda low, high: high,
    ):
        found = weighted_sum(problem, stored, held_commands(problem, draw))
        assert found >= stored.bound * (1 - 1e-5)


def test_the_least_weighted_sum_is_the_bound():
    """Over all commands, from the influence of each, by runs of `simulate` under one at a time."""
    problem = load("unknown_mass")
    stored = published("unknown_mass")["test"][0]
    count = round(float(problem.case.run.duration) / problem.period)
    nothing = np.zeros((count, 1))
    base = weighted_sum(problem, stored, nothing)
    influence = np.zeros(count)
    last = int(np.ceil(stored.places[0].max() / problem.case.run.sample_rate / problem.period))
    for k in range(min(last, count)):
        commands = nothing.copy()
        commands[k] = 1.0
        influence[k] = weighted_sum(problem, stored, commands) - base
    (limits,) = [one.command_limits() for one in problem.case.driven]
    least = base + sum(min(float(c) * influence_k for c in limits) for influence_k in influence)
    assert_allclose(least, stored.bound, rtol=1e-5)


@pytest.mark.parametrize("name", ["patch", "late_sensor", "saturated"])
def test_bounds_are_found_again(name):
    problem = load(name)
    seed = TEST_SEEDS[-1]
    found, stored = compute_attainable(problem, problem.test_load(seed)), attainable(problem, seed)
    assert_allclose(found.bound, stored.bound, rtol=1e-6)
    assert_allclose(found.uncontrolled, stored.uncontrolled, rtol=1e-6)


@pytest.mark.parametrize(
    "name", ["unknown_mass", "late_sensor", "footbridge", "patch", "saturated"]
)
def test_baselines_have_the_stored_scores(name):
    seeds = TEST_SEEDS[:2]
    found, stored = jb.benchmark.score(name, seed=seeds), jb.benchmark.baselines()[name]
    assert_allclose(found.shares, stored.shares[:2], atol=1e-4)
    assert found.seeds == seeds and found.worst <= found.mean <= 1


class Waiting:
    """A policy that does nothing, and counts the starts of runs."""

    def __init__(self):
        self.starts = 0

    def reset(self):
        self.starts += 1

    def __call__(self, observation):
        assert observation.shape == (2,)
        return [0.0]


def test_a_policy_that_does_nothing_has_the_share_zero():
    policy = Waiting()
    found = jb.benchmark.score("unknown_mass", policy, seed=[1, 7])
    assert policy.starts == 2
    assert_allclose(found.shares, 0, atol=1e-6)
    other = compute_attainable(load("unknown_mass"), load("unknown_mass").test_load(7))
    assert_allclose(found.peaks[1], other.uncontrolled, rtol=1e-6)


def test_a_run_that_diverges_counts_minus_one():
    found = dataclasses.replace(
        jb.benchmark.baselines()["patch"], shares=np.array([0.5, np.nan, -7.0, 0.5, 0.5])
    )
    assert_allclose(found.mean, -0.1)
    assert found.worst == -1


def test_controllers_of_other_loops_are_refused():
    problem = load("patch")
    law = problem.case.controller
    for change, sentence in (
        ({"period": np.array(0.02)}, r"controller.period must be 0.01"),
        ({"delay": np.array(0.01)}, "controller.delay must be left out"),
        ({"estimator": None}, "controller.estimator must be given"),
    ):
        with pytest.raises(ValueError, match=sentence):
            jb.benchmark.score(problem, dataclasses.replace(law, **change))
    with pytest.raises(ValueError, match="no problem 'rope'"):
        load("rope")
    with pytest.raises(ValueError, match="takes a controller"):
        jb.benchmark.score("patch", 3.0)


def test_data_are_part_of_the_package():
    top = resources.files("jaxbeam.benchmark")
    assert {f"{name}.toml" for name in names()} == {
        path.name for path in (top / "problems").iterdir()
    }
    assert json.loads((top / "bounds.json").read_text("utf-8"))


PATCH = {"length": 0.6, "rigidity": 13.211, "density": 0.812}
SHAKER = {"length": 0.6, "rigidity": 11.68, "density": 0.535}
OWN = {  # beam, period, moving masses as (kg, m/s, s of entry), places, limits, rate
    "unknown_mass": lambda m: (PATCH, 0.01, [(m, 1.2, 0.0)], [0.3], (-2.5, 7.5), np.inf),
    "saturated": lambda m, v: (PATCH, 0.01, [(m, v, 0.0)], [0.3], (-0.5, 1.5), 20.0),
    "stream": lambda a, b, c, second, third: (
        PATCH, 0.01, [(a, 1.0, 0.0), (b, 1.0, second), (c, 1.0, third)], [0.3], (-2.5, 7.5), np.inf
    ),
    "shaker": lambda m, v: (
        SHAKER, 0.005, [(m, v, 0.0)], [0.15, 0.25, 0.35], (-2.0, 2.0), np.inf
    ),
}  # fmt: skip


@functools.cache
def _own_response(name: str):
    """Deflections (m) at the samples without commands, and those of each command, by scipy.

    Moving masses on three sine modes, written down by hand: with the couples of a patch, or with a
    shaker whose suspension and lag are states, the last one its voltage behind the lag. Rows are
    samples, four a period, of one place after the other.
    """
    problem = load(name)
    beam, period, masses, places, _, _ = OWN[name](*problem.test_load(TEST_SEEDS[0]))
    length, gravity = beam["length"], 9.81
    n, modal_mass = np.arange(1, 4) * np.pi / length, beam["density"] * length / 2
    frequency = n**2 * np.sqrt(beam["rigidity"] / beam["density"])
    spring, dashpot = np.diag(modal_mass * frequency**2), np.diag(0.06 * modal_mass * frequency)
    lag = 1e4
    if beam is SHAKER:
        at = np.sin(n * 0.5)
        spring, dashpot = (
            spring + 3500.0 * np.outer(at, at), dashpot + 80.0 * np.outer(at, at)
        )  # fmt: skip
        on_voltage = 4.6 * at
    else:
        per_volt = 8.292e-4 * 200.0 * 0.32  # N m/V
        on_voltage = -per_volt * n * (np.cos(n * 0.3425) - np.cos(n * 0.2575))

    def rates(t, flat, on_beam):
        """Rates of the fundamental matrix: columns of the seven states, of a command, of one."""
        inertia, right = modal_mass * np.eye(3), np.zeros((3, 9))
        right[:, :3], right[:, 3:6] = -spring, -dashpot
        right[:, 6 if beam is SHAKER else 7] = on_voltage
        for mass, speed, entry in on_beam:
            x = speed * (t - entry)
            shape, slope = np.sin(n * x), n * np.cos(n * x)
            # y'' = s q'' + 2 v s' q' + v^2 s'' q under the mass, which presses downwards.
            inertia += mass * np.outer(shape, shape)
            right[:, :3] += mass * speed**2 * np.outer(shape, n**2 * shape)
            right[:, 3:6] -= 2 * mass * speed * np.outer(shape, slope)
            right[:, 8] -= mass * gravity * shape
        z = np.concatenate([flat.reshape(7, 9), np.eye(9)[7:]])
        follows = lag * (z[7] - z[6]) if beam is SHAKER else np.zeros(9)
        return np.concatenate([z[3:6], np.linalg.solve(inertia, right @ z), follows[None]]).ravel()

    count = round(float(problem.case.run.duration) / period)
    passages = [(entry, entry + length / speed) for _, speed, entry in masses]
    columns, rows = np.zeros((7, 1 + count)), []
    for k in range(count):
        for sample in range(4):
            start, end = (k + np.array([sample, sample + 1]) / 4) * period
            inside = {t for both in passages for t in both if start < t < end}
            for a, b in itertools.pairwise(sorted({start, end, *inside})):
                middle = (a + b) / 2
                on_beam = [
                    one for one, (entry, leave) in zip(masses, passages, strict=True)
                    if entry < middle < leave
                ]  # fmt: skip
                found = scipy.integrate.solve_ivp(
                    rates, (a, b), np.eye(7, 9).ravel(), "DOP853",
                    args=(on_beam,), rtol=1e-9, atol=1e-13,
                )  # fmt: skip
                maps = found.y[:, -1].reshape(7, 9)
                columns = maps[:, :7] @ columns
                columns[:, 1 + k] += maps[:, 7]
                columns[:, 0] += maps[:, 8]
            rows.append(np.sin(np.outer(places, n)) @ columns[:3])
    rows = np.concatenate(np.swapaxes(rows, 0, 1))
    return rows[:, 0], rows[:, 1:]


def _least_peak(base, response, limits, change):
    """Least peak (m) over all commands within limits and changes a period, by linear programs.

    The rows of a program are those of the samples that its predecessors violate.
    """
    count, scale = response.shape[1], np.abs(base).max()
    used = np.zeros(len(base), bool)
    used[np.argmax(np.abs(base))] = True
    steps = np.eye(count) - np.eye(count, k=-1)
    while True:
        own, at = response[used] / scale, base[used] / scale
        matrix = np.pad(np.concatenate([own, -own]), ((0, 0), (0, 1)), constant_values=-1)
        right = np.concatenate([-at, at])
        if np.isfinite(change):
            matrix = np.concatenate(
                [matrix, np.pad(np.concatenate([steps, -steps]), [(0, 0), (0, 1)])]
            )
            right = np.append(right, np.full(2 * count, change))
        found = scipy.optimize.linprog(
            np.append(np.zeros(count), 1.0), matrix, right, bounds=[limits] * count + [(0, None)]
        )
        peaks = np.abs(base + response @ found.x[:-1]) / scale
        violated = peaks > found.x[-1] + 1e-7
        if not violated.any():
            return scale * found.x[-1]
        used |= peaks > found.x[-1] + 0.1 * (peaks.max() - found.x[-1])


@pytest.mark.parametrize("name", OWN)
def test_a_simulation_by_scipy_has_the_same_peaks_bound_and_score(name):
    """Uncontrolled, under random commands and those of the baseline, and least of all."""
    problem, stored = load(name), published(name)["test"][0]
    base, response = _own_response(name)
    *_, limits, rate = OWN[name](*stored.load)
    assert_allclose(np.abs(base).max(), stored.uncontrolled, rtol=1e-6)
    commands = held_commands(problem, np.random.default_rng(1).uniform)
    values = np.append(commands, commands[-1:], axis=0).T
    times = np.arange(len(values[0])) * problem.period
    law = jb.Prescribed(offsets=[0.0], period=problem.period, times=times, values=values)
    case = dataclasses.replace(problem.run_case(stored.load), controller=law)
    found = scoring.sampled_peak(problem, case)
    assert_allclose(found, np.abs(base + response @ commands[:, 0]).max(), rtol=1e-6)
    least = _least_peak(base, response, limits, rate * problem.period)
    assert_allclose(least, stored.bound, rtol=1e-5)
    run = problem.run_case(stored.load, TEST_SEEDS[0])
    record = jb.simulate(scoring.design_case(problem, problem.case.controller, run))
    peak = np.abs(base + response @ np.asarray(record.command)[:-1:4, 0]).max()
    share = (np.abs(base).max() - peak) / (np.abs(base).max() - least)
    assert_allclose(share, jb.benchmark.baselines()[name].shares[0], atol=2e-4)


def _railway(load):
    """Deflections (m) at the samples of the railway without commands, and those of each command.

    Axles as forces on three sine modes, with the mass of the damper as a fourth coordinate: all of
    it linear, with constant coefficients, and written down by hand.
    """
    length, stiffness, density, damping, period, steps = 25.0, 3e10, 15e3, 0.01, 0.02, 120
    mass, own = 3750.0, 2 * np.pi * 3.48
    (speed,) = load
    n, modal_mass = np.arange(1, 4) * np.pi / length, density * length / 2
    frequency, middle = n**2 * np.sqrt(stiffness / density), np.sin(n * length / 2)
    stretch = np.append(-middle, 1.0)  # of the spring of the damper
    inertia = np.diag([modal_mass] * 3 + [mass])
    spring = np.diag([*(modal_mass * frequency**2), 0.0])
    spring += mass * own**2 * np.outer(stretch, stretch)
    dashpot = np.diag([*(2 * modal_mass * damping * frequency), 0.0])
    dashpot += 2 * 0.086 * mass * own * np.outer(stretch, stretch)
    upwards = np.append(middle, 0.0)

    def accelerations(z, force):
        return np.linalg.solve(inertia, force - spring @ z[:4] - dashpot @ z[4:])

    axles = np.array([0.0, 3.0, 14.0, 17.0, 20.525, 22.525, 35.7625, 37.7625, 53.7625, 55.7625])
    axles = np.append(axles, [71.7625, 73.7625, 89.7625, 91.7625])

    def rates(t, z):
        at = speed * t - axles
        shapes = np.sin(np.outer(at[on_beam], n)).sum(axis=0)
        return np.append(z[4:], accelerations(z, np.append(-170e3 * shapes, 0.0)))

    passages = np.concatenate([axles, axles + length]) / speed
    times, z, base = np.arange(2 * steps + 1) * period / 2, np.zeros(8), [0.0]
    places = np.unique([*times, *passages[passages < times[-1]]])
    for start, end in zip(places[:-1], places[1:], strict=True):
        middle_of_axles = speed * (start + end) / 2 - axles
        on_beam = (middle_of_axles > 0) & (middle_of_axles < length)
        found = scipy.integrate.solve_ivp(rates, (start, end), z, "DOP853", rtol=1e-9, atol=1e-14)
        z = found.y[:, -1]
        if end in times:
            base.append(middle @ z[:3])
    state = np.zeros((8, 8))
    state[:4, 4:] = np.eye(4)
    state[4:] = np.linalg.solve(inertia, np.concatenate([-spring, -dashpot], axis=1))
    held = np.append(np.zeros(4), np.linalg.solve(inertia, upwards))
    both = np.zeros((9, 9))
    both[:8] = np.append(state, held[:, None], axis=1)
    step = scipy.linalg.expm(both * period / 2)
    transition, held = step[:8, :8], step[:8, 8]
    column, z = [0.0], np.zeros(8)  # of the first command, which acts for two samples
    for k in range(2 * steps):
        z = transition @ z + held * (k < 2)
        column.append(middle @ z[:3])
    column = np.array(column)
    shifted = [np.append(np.zeros(2 * k), column[: len(column) - 2 * k]) for k in range(steps)]
    return np.array(base), np.stack(shifted, axis=1)


def test_the_railway_by_scipy_has_the_same_peaks_and_bound():
    """Uncontrolled, under held commands, and least of all: by an ODE and a linear program."""
    problem, stored = load("railway"), published("railway")["test"][0]
    base, response = _railway(problem.test_load(TEST_SEEDS[0]))
    assert_allclose(np.abs(base).max(), stored.uncontrolled, rtol=1e-6)
    commands = held_commands(problem, np.random.default_rng(1).uniform)
    law = jb.Prescribed(
        offsets=[0.0],
        period=problem.period,
        times=np.arange(len(commands) + 1) * problem.period,
        values=np.append(commands, commands[-1:], axis=0).T,
    )
    case = dataclasses.replace(problem.run_case(stored.load), controller=law)
    found = scoring.sampled_peak(problem, case)
    assert_allclose(found, np.abs(base + response @ commands[:, 0]).max(), rtol=1e-6)
    scale = np.abs(base).max()
    rows = np.concatenate([response, -response]) / scale
    solution = scipy.optimize.linprog(
        np.append(np.zeros(rows.shape[1]), 1.0),
        np.append(rows, -np.ones((len(rows), 1)), axis=1),
        -np.concatenate([base, -base]) / scale,
        bounds=[(-5e4, 5e4)] * rows.shape[1] + [(0, None)],
    )
    assert_allclose(solution.x[-1] * scale, stored.bound, rtol=1e-5)

"""The sampled regulator: against scipy and python-control, its limits, and what it costs."""

import json
import warnings

import control
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.case.validation import check
from jaxbeam.cli import main
from jaxbeam.control import LQR, DiscreteLQR, SamplingWarning
from jaxbeam.control.optimal.sampled_lqr import discrete_lq_problem
from jaxbeam.control.optimal.sampling_loss import sampled_reachability
from jaxbeam.model.modes import lay_out

WEIGHTS = {
    "state_weight": [1e3, 1e2, 10.0, 0.1, 0.01, 0.01, 0.0],
    "command_weight": [9e-5],
    "coordinates": "sine",
}


def rig(controller=None, modes=3, **shaker):
    """The rig of chapter 5 of the thesis; its shaker stands at 0.5 m."""
    shaker = {"stiffness": 12000.0, "damping": 80.0, "force_per_volt": 4.6} | shaker
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=modes),
        actuators=[jb.Shaker(0.5, **shaker)],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingForce(force=5.0, speed=0.55)],
        controller=controller,
        run=jb.Run(0.2, sample_rate=500.0),
    )


def modelled(case):
    layout = lay_out(case)
    return eqx.filter_jit(lambda case: jb.state_space(case, "sine", layout))(case)


@pytest.fixture(scope="module")
def model():
    return modelled(rig())


@eqx.filter_jit
def designed(law, model):
    return law.gains(model)


def close(found, expected, tolerance):
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))


def integrated(A, B, Q, R, spans):
    """Drift, pushes and cost of (x, u1, u2), u1 held for the first span (s), u2 for the other.

    By Van Loan's blocks, in units in which they are of like size.
    """
    n, m = B.shape
    state, cost = np.eye(n, n + 2 * m), np.zeros((n + 2 * m,) * 2)
    for i, span in enumerate(spans):
        command = np.eye(m, n + 2 * m, n + i * m)
        rate = np.block([[A, B], [np.zeros((m, n + m))]])
        toll = scipy.linalg.block_diag(Q, R)
        parts = 64  # short ones: the blocks hold a growing exponential
        block = np.block([[-rate.T, toll], [np.zeros_like(rate), rate]]) * span / parts
        whole = scipy.linalg.expm(block)
        flow = whole[n + m :, n + m :]
        spent = flow.T @ whole[: n + m, n + m :]
        for _ in range(parts):
            both = np.vstack([state, command])
            cost = cost + both.T @ spent @ both
            state = (flow @ both)[:n]
    return state, cost


@pytest.mark.parametrize("late", [None, 0.7e-3])
def test_the_sampled_problem_is_the_integral(model, late):
    plant, period = model.unloaded, 2e-3
    Q, R = LQR(**WEIGHTS).weights(model)
    A, B, Qs, Rs, N = discrete_lq_problem(
        plant.A, plant.B, Q, R, jnp.asarray(period), None if late is None else jnp.asarray(late)
    )
    spans = (0.0 if late is None else late, period - (late or 0.0))
    state, cost = integrated(*map(np.asarray, (plant.A, plant.B, Q, R)), spans)
    units = np.sqrt(cost.diagonal() + 1e-12 * cost.max())
    found = np.block([[Qs, N], [N.T, Rs]])
    assert_allclose(found / np.outer(units, units), cost / np.outer(units, units), atol=1e-9)
    close(np.hstack([A, B])[:7, :7], state[:, :7], 1e-10)
    close(np.hstack([A, B])[:7, 7:], state[:, 7:], 1e-10)


@pytest.mark.parametrize("period", [2e-4, 2e-3])
def test_gain_as_scipy_and_python_control_find_it(model, period):
    plant = model.unloaded
    Q, R = LQR(**WEIGHTS).weights(model)
    state, cost = integrated(*map(np.asarray, (plant.A, plant.B, Q, R)), (0.0, period))
    A, B = state[:, :7], state[:, 8:]
    kept = np.r_[0:7, 8]
    cost = (cost + cost.T)[np.ix_(kept, kept)] / 2
    Q, N, R = cost[:7, :7], cost[:7, 7:], cost[7:, 7:]
    P = scipy.linalg.solve_discrete_are(A, B, Q, R, s=N)
    expected = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + N.T)
    found = designed(DiscreteLQR(**WEIGHTS, period=period), model)
    close(found, expected, 1e-6)
    close(found, control.dlqr(A, B, Q, R, N)[0], 1e-6)


def test_it_becomes_the_continuous_regulator(model):
    """A hold is late by half a period: the difference is of first order."""
    exact = designed(LQR(**WEIGHTS), model)
    far, near = (
        np.max(np.abs(designed(DiscreteLQR(**WEIGHTS, period=period), model) - exact))
        / np.max(np.abs(exact))
        for period in (2e-6, 1e-6)
    )
    assert near < 0.02
    assert far / near == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("options", [{"delay": 1.5e-3}, {"input_rate_weight": [1e-6]}, {}])
def test_no_other_gain_costs_less(model, options):
    """The cost of runs from a start, by an integration of its own, is lowest for the gain found."""
    law = DiscreteLQR(**WEIGHTS, period=2e-3, **options)
    gain = np.asarray(designed(law, model))
    plant = model.unloaded
    A, B = np.asarray(plant.A), np.asarray(plant.B)
    Q, R = (np.asarray(weight) for weight in law.weights(model))
    late, rate = options.get("delay", 0.0), options.get("input_rate_weight", [0.0])[0]
    state, spent = integrated(A, B, Q, R, (late, law.period - late))

    def cost(gain):
        x, last, total = np.array([1e-3, -4e-4, 2e-4, 0.03, 0.01, -0.1, 0.2]), np.zeros(1), 0.0
        for _ in range(600):
            command = -gain @ np.concatenate([x, last])[: gain.shape[1]]
            both = np.concatenate([x, last, command])
            total += both @ spent @ both + rate * np.sum((command - last) ** 2) / law.period
            x, last = state @ both, command
        return float(total)

    least = cost(gain)
    for change in np.random.default_rng(0).normal(size=(4, *gain.shape)):
        step = 5e-3 * change * np.abs(gain)
        up, down = cost(gain + step) - least, cost(gain - step) - least
        assert up > 0 and down > 0
        assert abs(up - down) < 0.3 * (up + down)


def test_limits_are_those_of_the_thesis():
    """Eq. (5.6): half a period of each damped mode.

    Without the suspension: pi / omega, omega_n = (n pi / L)^2 sqrt(EI / m), less the damping.
    """
    omega = (np.arange(1, 4) * np.pi / 0.6) ** 2 * np.sqrt(11.68 / 0.535)
    free = rig(stiffness=0.0, damping=0.0)
    expected = np.pi / (omega * np.sqrt(1 - 0.03**2))
    assert_allclose(jb.sampling_limit(free), expected, rtol=1e-9)
    stiffer = jb.sampling_limit(rig(damping=0.0))
    assert stiffer.shape == (3,) and np.all(stiffer < expected)


def test_control_is_lost_at_the_limit():
    """Of one mode: by its reach, by the rank of (B, A B), and by what the best gain does."""
    case = rig(modes=1, stiffness=0.0, damping=0.0, bandwidth=1e5)
    model = modelled(case)
    plant, limit = model.unloaded, float(jb.sampling_limit(case)[0])

    def smallest(period):
        """Of the modal Gramian of held commands over that of any, by scipy's equations."""
        fade = 0.5 / 0.2 * np.eye(3)
        A, B = np.asarray(plant.A) - fade, np.asarray(plant.B)
        drift = scipy.linalg.expm(A * period)
        push = np.linalg.solve(A, (drift - np.eye(3)) @ B)
        whole = scipy.linalg.solve_continuous_lyapunov(A, -B @ B.T)
        held = scipy.linalg.solve_discrete_lyapunov(drift, push @ push.T) / period
        # The coordinates of the mode itself, without what its lag adds.
        values, rows, *_ = scipy.linalg.eig(A, left=True, right=False)
        row = rows[:, np.argmax(values.imag)].conj()
        rows = np.stack([row.real, row.imag])
        return scipy.linalg.eigvalsh(rows @ held @ rows.T, rows @ whole @ rows.T)[0]

    shares = []
    for share in (0.25, 0.5, 0.9, 1.0, 1.25, 2.0):
        kept, omega = sampled_reachability(plant, share * limit, 0.2)
        assert omega == pytest.approx(np.pi / limit)
        assert_allclose(kept, smallest(share * limit), rtol=1e-6, atol=1e-9)
        shares.append(kept)
    assert shares[0] > 0.9 and shares[1] > 0.7
    assert shares[3] < 1e-6 and shares[5] < 1e-6  # at the limit, and at twice that
    assert shares[2] < 0.5 and shares[4] < 0.5

    sampled = plant.discretize(limit)
    values, rows, *_ = scipy.linalg.eig(plant.A, left=True, right=False)
    row = rows[:, np.argmax(values.imag)].conj()
    turned = np.stack([row, row.conj()]) @ np.hstack([sampled.B, sampled.A @ sampled.B])
    sizes = np.linalg.svd(turned)[1]
    assert sizes[1] < 1e-9 * sizes[0]
    # No gain damps the mode there: half of it stays as damped as it was.
    weights = {"state_weight": [1e3, 1.0, 0.0], "command_weight": [1e-6], "coordinates": "sine"}
    free = np.abs(np.linalg.eigvals(sampled.A)).max()
    moved = []
    for share in (0.5, 1.0):
        sampled = plant.discretize(share * limit)
        gain = designed(DiscreteLQR(**weights, period=share * limit), model)
        moved.append(np.abs(np.linalg.eigvals(sampled.A - sampled.B @ gain)).max() / free**share)
    assert moved[0] < 0.75
    assert moved[1] == pytest.approx(1.0, abs=1e-6)


def test_slow_samples_are_warned_of(tmp_path, capsys):
    """In Python by a warning, on the command line by one sentence, before the run."""
    slow = rig(DiscreteLQR(**WEIGHTS, period=5e-3))
    with pytest.warns(
        SamplingWarning, match="hardly reach the mode at .* Hz, whose sampling limit"
    ):
        check(slow)
    with pytest.warns(SamplingWarning):
        check(rig(LQR(**WEIGHTS, period=5e-3)))
    check(rig(DiscreteLQR(**WEIGHTS, period=2e-3)))
    path = tmp_path / "slow.toml"
    jb.save_case(slow, path)
    with warnings.catch_warnings(), pytest.raises(SystemExit) as ended:
        warnings.simplefilter("default")
        main(["modes", str(path), "--json"])
    printed = capsys.readouterr()
    assert ended.value.code == 0 and json.loads(printed.out)
    assert printed.err.count("hardly reach the mode") == 1
    assert printed.err.startswith("jaxbeam: warning: commands held for 0.005 s")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "controller.period must be given"),
        ({"period": 1e-3, "delay": 1e-3}, "controller.delay must be less than the period"),
        ({"period": 1e-3, "input_rate_weight": [1.0, 1.0]}, "must have 1 entries, not 2"),
    ],
)
def test_faults_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        check(rig(DiscreteLQR(**WEIGHTS, **options)))


@pytest.mark.slow
def test_in_the_loop_it_is_what_was_designed(model):
    """The poles of the loop from tick to tick are those of the problem of its design, closed."""
    law = DiscreteLQR(**WEIGHTS, period=2e-3, delay=5e-4, input_rate_weight=[1e-8])
    plant, (Q, R) = model.unloaded, law.weights(model)
    state, _ = integrated(*map(np.asarray, (plant.A, plant.B, Q, R)), (5e-4, 1.5e-3))
    drift, push = np.vstack([state[:, :8], np.zeros((1, 8))]), np.append(state[:, 8:], [[1.0]], 0)
    expected = np.abs(np.linalg.eigvals(drift - push @ np.asarray(designed(law, model))))
    found = np.abs(np.linalg.eigvals(linearised_loop(rig(law), 0.0).closed_matrix))
    assert_allclose(np.sort(found)[-7:], np.sort(expected)[-7:], rtol=1e-7)

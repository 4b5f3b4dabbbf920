"""Priors, scales, robust losses, many starts, stages: on readings that are a formula."""

import sys

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from tests.tuning.stand_in import CASE, NOISE, PULLS, TRUTH, campaign, clean, fit, formula, search
from tuning.fit.identify import _stage_mask, identify
from tuning.fit.loss import HUBER_THRESHOLD, check_loss, robust_residual, variance_factor
from tuning.fit.multi_start import draw_start_points, multi_start
from tuning.parameters.free import FreeParameter, free_parameters
from tuning.parameters.prior import Prior

ADDRESSES = list(TRUTH)
VALUES = np.array(list(TRUTH.values()))


@pytest.fixture(scope="module")
def plain():
    return fit()


def test_the_optimum_is_that_of_scipy():
    """Its least squares, with differences for derivatives, from the same start."""
    plain = fit(search(logs=1))

    def residuals(values):
        residuals = plain.dataset.measured[0, :, 0] - formula(*values, PULLS[0])
        return np.asarray(residuals) / plain.noise[0, 0]

    found = scipy.optimize.least_squares(residuals, plain.start_values, x_scale=[20, 0.03, 0.2],
                                         xtol=1e-12, ftol=1e-14, gtol=1e-12)  # fmt: skip
    np.testing.assert_allclose(plain.values, found.x, rtol=1e-6)
    errors = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    np.testing.assert_allclose(plain.errors, errors, rtol=0.15)  # some residuals look coloured


# What scipy says of the losses, as functions of the squared residual.
RHO = {
    "squares": lambda z: z,
    "soft-l1": lambda z: 2 * (np.sqrt(1 + z) - 1),
    "huber": lambda z: np.where(
        z <= HUBER_THRESHOLD**2, z, 2 * HUBER_THRESHOLD * np.sqrt(z) - HUBER_THRESHOLD**2
    ),
}


@pytest.mark.parametrize("loss", RHO)
def test_losses(loss):
    residuals = np.linspace(-9, 9, 101)
    np.testing.assert_allclose(
        np.asarray(robust_residual(loss, jnp.asarray(residuals))) ** 2, RHO[loss](residuals**2), rtol=1e-12,
        atol=1e-14,
    )  # fmt: skip
    normal = np.random.default_rng(0).normal(size=100_000)
    # Huber's constant is made for an efficiency of 95 %.
    expected = {"squares": 1.0, "huber": 1 / 0.95, "soft-l1": None}[loss]
    assert expected is None or variance_factor(loss, normal) == pytest.approx(expected, rel=0.01)


def test_unknown_losses_are_refused():
    with pytest.raises(ValueError, match="one of squares, soft-l1, huber, not 'cauchy'"):
        check_loss("cauchy")


@pytest.mark.parametrize("loss", ["soft-l1", "huber"])
def test_outliers_hardly_move_a_robust_fit(loss):
    rng = np.random.default_rng(3)
    measured = clean() + NOISE * rng.normal(size=clean().shape)
    hit = rng.random(measured.shape) < 0.08
    measured[hit] += 0.7
    ordinary, robust = (fit(search(loss=name, measured=measured)) for name in ("squares", loss))
    offset = ADDRESSES.index("sensors.0.offset")
    assert abs(ordinary.values[offset] - 0.2) > 0.04
    assert np.all(np.abs(robust.values - VALUES) < 4 * robust.errors)
    assert robust.errors[offset] < ordinary.errors[offset] / 3
    assert np.all(robust.noise < 2 * NOISE) and np.all(ordinary.noise > 5 * NOISE)


def test_masked_samples_do_not_count():
    measured, real = clean() + 0.0, np.ones(clean().shape)
    measured[0, 30:40], real[0, 30:40] = 50.0, 0.0
    found = fit(search(measured=measured, real=real))
    np.testing.assert_allclose(found.values, VALUES, rtol=1e-6)
    assert np.isnan(found.residuals[0, 30:40]).all()


def test_a_prior_counts_as_a_measurement(plain):
    """With a prior as certain as the data, the value lies midway and the error is smaller."""
    damping = ADDRESSES.index("beam.damping_ratio")
    error, value = plain.errors[damping], plain.values[damping]
    known = Prior(mean=float(value + 2 * error), deviation=float(error))
    found = fit(search(free=dict.fromkeys(TRUTH) | {"beam.damping_ratio": known}))
    assert found.values[damping] == pytest.approx(value + error, abs=0.1 * error)
    assert found.errors[damping] == pytest.approx(error / np.sqrt(2), rel=0.05)


def test_a_prior_tells_what_the_data_cannot():
    known = {"beam.mass_per_length": Prior(mean=2.0, deviation=0.1)}
    made = campaign()
    blind = search(free=dict.fromkeys(TRUTH))
    assert made.measured.shape == blind.data.measured.shape
    number = free_parameters([CASE], known, 1.0)[0]
    assert number.low == 0.0 and number.prior.prior_residual(jnp.asarray(2.2)) == pytest.approx(2.0)


@pytest.mark.parametrize("scale", ["log", "logit"])
def test_scales(scale):
    number = FreeParameter("x", "m", 0.1, 0.01, 100.0, 99.99, Prior(0.01, 100.0, scale=scale))
    for value in (0.15, 1.0, 3.0, 99.0):
        assert float(
            number.from_unbounded(jnp.asarray(number.to_unbounded(value)))
        ) == pytest.approx(value)
    shares = number.unbounded_at_share(np.array([0.25, 0.5, 0.75]))
    values = np.array([float(number.from_unbounded(jnp.asarray(y))) for y in shares])
    expected = [0.1, 1.0, 10.0] if scale == "log" else [25.0075, 50.005, 75.0025]
    np.testing.assert_allclose(values, expected, rtol=1e-9)


@pytest.mark.parametrize(
    "given, words",
    [
        ({"scale": "cube"}, "a scale is one of plain, log, logit, not 'cube'"),
        ({"mean": 1.0}, "a prior needs both a mean and a deviation"),
        ({"mean": 1.0, "deviation": 0.0}, "the deviation of a prior must be positive, not 0"),
        ({"scale": "log"}, "the scale 'log' needs two bounds, low and high"),
        ({"low": -1.0, "high": 1.0, "scale": "log"}, "on a log scale bounds and mean must be"),
    ],
)
def test_faulty_beliefs(given, words):
    with pytest.raises(ValueError, match=words):
        Prior(**given)


def test_numbers_of_every_log():
    found = free_parameters([CASE, CASE], {"logs.*.loads.0.speed": (0.5, 2.0)}, 1.0)
    assert [number.address for number in found] == [f"logs.{i}.loads.0.speed" for i in (0, 1)]
    with pytest.raises(ValueError, match=r"logs.0.loads.0.speed is free twice; name it once"):
        twice = {"logs.*.loads.0.speed": None, "logs.0.loads.0.speed": None}
        free_parameters([CASE, CASE], twice, 1.0)


def test_stages_move_only_what_they_name(plain):
    mask = _stage_mask(plain.numbers, ["beam.damping_ratio", "sensors.0.offset"])
    assert mask.tolist() == [False, True, True]
    moved = plain.search.estimate(plain.campaign.measured, free=mask)
    assert moved.values[0] == pytest.approx(19.0) and moved.values[2] != pytest.approx(0.0)
    assert moved.uncertainty.errors[0] == 0.0 < moved.uncertainty.errors[1]
    with pytest.raises(ValueError, match="a stage fits beam.length, which is not free; free are"):
        _stage_mask(plain.numbers, ["beam.length"])


BOUNDS = {
    "beam.flexural_rigidity": (4.0, 60.0),
    "beam.damping_ratio": Prior(0.001, 0.2, scale="log"),
    "sensors.0.offset": None,
}


@pytest.fixture(scope="module")
def wide():
    return search(free=BOUNDS)


def test_many_starts_find_several_minima(wide):
    """An oscillation fitted to one of another frequency: between them the misfit has hills."""
    minima = multi_start(wide, wide.campaign.measured, 12, seed=1)
    assert len(minima) > 1 and sum(found.starts for found in minima) == 12
    costs = [found.cost for found in minima]
    assert costs == sorted(costs) and costs[1] > 2 * costs[0]
    np.testing.assert_allclose(minima[0].values, VALUES, rtol=0.1)


def test_starts_fill_the_bounds(wide):
    points = draw_start_points(wide.numbers, 9, seed=0)
    values = np.array([wide.values_at(point) for point in points])
    np.testing.assert_allclose(values[0], [19.0, 0.02, 0.0], atol=1e-9)
    eighths = np.floor((values[1:, 0] - 4) / 7).astype(int)  # a Latin hypercube: one in each
    assert sorted(eighths) == list(range(8))
    logs = np.floor(8 * np.log(values[1:, 1] / 0.001) / np.log(200)).astype(int)
    assert sorted(logs) == list(range(8))
    assert len(draw_start_points(wide.numbers, 1, seed=0)) == 1


def test_a_search_that_was_killed_goes_on_to_the_same_end(wide, tmp_path, monkeypatch):
    file = tmp_path / "search.npz"
    whole = multi_start(wide, wide.campaign.measured, 12, seed=1)

    class Killed(Exception):
        pass

    def killing(*given, **about):
        if file.exists():
            raise Killed
        return minimise(*given, **about)

    minimise = wide.minimise
    monkeypatch.setattr(wide, "minimise", killing)
    with pytest.raises(Killed):
        multi_start(wide, wide.campaign.measured, 12, seed=1, checkpoint=file, digest="this")
    monkeypatch.undo()
    resumed = multi_start(wide, wide.campaign.measured, 12, seed=1, checkpoint=file, digest="this")
    assert [found.cost for found in resumed] == [found.cost for found in whole]
    np.testing.assert_array_equal(resumed[0].values, whole[0].values)
    with pytest.raises(ValueError, match="belongs to another search"):
        multi_start(wide, wide.campaign.measured, 12, seed=1, checkpoint=file, digest="that")


def test_identify_takes_the_lowest_minimum_and_goes_on(tmp_path, monkeypatch):
    """The whole way, but for the campaign, which is a formula; a wrong start alone fails."""
    made = campaign()
    monkeypatch.setattr(sys.modules["tuning.fit.identify"], "prepare", lambda case, logs: made)
    far = {address: BOUNDS[address] for address in ADDRESSES}
    file = tmp_path / "search.npz"
    found = identify(CASE, made.logs, far, starts=12, seed=1, checkpoint=file)
    assert np.all(np.abs(found.values - VALUES) < 4 * found.errors)
    assert sum(minimum.starts for minimum in found.minima) == 12 and file.exists()
    assert "minima from 12 starts:" in str(found)
    with pytest.raises(FileExistsError, match="exists: resume that search, or delete it"):
        identify(CASE, made.logs, far, starts=12, seed=1, checkpoint=file)
    again = identify(CASE, made.logs, far, starts=12, seed=1, checkpoint=file, resume=True)
    np.testing.assert_array_equal(again.values, found.values)
    with pytest.raises(ValueError, match="belongs to another search"):
        identify(CASE, made.logs, far, starts=12, seed=2, checkpoint=file, resume=True)
    staged = identify(CASE, made.logs, list(TRUTH), stages=[["sensors.0.offset"]])
    np.testing.assert_allclose(staged.values, found.values, rtol=1e-5)
    with pytest.raises(ValueError, match="starts must be 1 or more, not 0"):
        identify(CASE, made.logs, far, starts=0)

"""Validation, profiles, posterior and storage of fits, on readings that are a formula."""

import dataclasses
import json
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxbeam as jb
from jaxbeam.case.case import replace
from jaxbeam.files.case_file import case_to_dict
from tests.oracles import finite_elements
from tests.tuning.finite_element_rigs import SAGGING, SHAKER, SimulatedIdentification, plant
from tests.tuning.small_rig import (
    AMPLITUDES,
    CASE,
    NOISE,
    TIMES,
    TRUTH,
    clean,
    dataset,
    fit,
    formula,
    least_squares,
)
from tuning.checkpoint import Checkpoint, save
from tuning.fit import model_validation, result
from tuning.fit.dataset import channel_residuals, residual_remarks, whiteness_p_value
from tuning.fit.least_squares import LocalMinimum, t_quantile
from tuning.fit.model_validation import compare_fits, cross_validate
from tuning.fit.report import write_report
from tuning.fit.result import fit_result
from tuning.fit.uncertainty import (
    Profile,
    _log_density,
    draw_by_nuts,
    profile,
    sample,
    with_diagnostics,
)
from tuning.parameters import Prior, to_unbounded

VALUES = np.array(list(TRUTH.values()))
NAMES = ["sensor 0"]


@pytest.fixture(scope="module")
def plain():
    return fit()


def refit(plain, measured, **options):
    """Fit of other samples by the same compiled program."""
    solution = plain.least_squares.solve(measured, **options)
    data = dataclasses.replace(plain.dataset, measured=measured)
    refitted = fit_result(plain.case, plain.least_squares, solution)
    return dataclasses.replace(refitted, dataset=data)


# Model validation.


def test_whiteness_of_known_noise():
    rng = np.random.default_rng(0)
    p_values = [whiteness_p_value(rng.normal(size=400)) for _ in range(300)]
    assert np.mean(np.array(p_values) < 0.1) == pytest.approx(0.1, abs=0.05)
    walk = np.convolve(rng.normal(size=400), np.ones(3) / 3, mode="valid")
    assert whiteness_p_value(walk) < 1e-9 and whiteness_p_value(np.zeros(50)) == 1.0
    assert whiteness_p_value(rng.normal(size=400) + 0.8) < 1e-9  # about an offset that a fit misses


def test_no_remarks_on_the_residuals_of_a_good_fit(plain):
    channels = plain.channel_residuals
    assert [(c.log, c.sensor) for c in channels] == [(0, 0), (1, 0), (2, 0)]
    assert residual_remarks(channels, ["run 0", "run 1", "run 2"], NAMES) == []
    np.testing.assert_allclose([c.noise for c in channels], NOISE, rtol=0.2)


def test_remarks_on_a_delayed_channel_and_autocorrelated_residuals(plain):
    measured = np.array(plain.dataset.measured)
    delayed = np.interp(TIMES - 0.004, TIMES, clean()[1, :, 0])
    measured[1, :, 0] = delayed + measured[1, :, 0] - clean()[1, :, 0]
    # Fitted to the other logs, so that no parameter compensates the delay.
    refitted = refit(plain, measured, included_logs=np.array([True, False, True]))
    _, channel, _ = refitted.channel_residuals
    assert channel.time_shift == pytest.approx(0.004, abs=4 * channel.time_shift_sd)
    assert channel.time_shift_sd < 0.001
    autocorrelation, delay = residual_remarks([channel], ["run 0", "run 1", "run 2"], NAMES)
    assert autocorrelation.startswith(
        "run 1: residuals are no white noise, so the model misses something"
    )
    assert delay.startswith("run 1: sensor 0 seems ") and " ms late (+- " in delay


def test_a_remark_on_an_offset_where_the_model_is_at_rest(plain):
    """60 samples at rest before the formula begins, in which the reading is 0."""
    rng = np.random.default_rng(5)
    model = np.vstack([np.zeros((60, 1)), clean()[1]])[None]
    times = (TIMES[1] - TIMES[0]) * np.arange(model.shape[1])[None]
    noise = NOISE * rng.normal(size=model.shape)
    for offset, remarks in ((0.0, 0), (2.0 * NOISE, 1)):
        (channel,) = channel_residuals(
            times, model, noise + offset, np.full((1, 1), NOISE), np.ones((1, 1))
        )
        assert abs(channel.offset - offset) < 4 * channel.offset_sd < NOISE
        found = [one for one in residual_remarks([channel], ["run"], NAMES) if "at rest" in one]
        assert len(found) == remarks
        assert all(one.endswith("which biases the fit: free its offset") for one in found)


def test_information_criteria(plain):
    """A model whose damping is held at a wrong value loses against the right one."""
    problem = plain.least_squares
    held = problem.solve(plain.dataset.measured, free=np.array([True, False, True]))
    undamped = dataclasses.replace(
        fit_result(plain.case, problem, held), parameters=plain.parameters[:2]
    )
    best, worse = compare_fits({"damped": plain, "0.02": undamped})
    assert (best.name, worse.name) == ("damped", "0.02")
    assert worse.bic - best.bic > 10 and best.weight > 0.99
    # White residuals, one channel per log: textbook formulas with independent samples.
    squares = np.nansum(plain.residuals**2, axis=(1, 2)) / TIMES.size
    counts = TIMES.size / plain.autocorrelation_factor[:, 0]
    log_likelihood = -np.sum(counts * (np.log(2 * np.pi * squares) + 1)) / 2
    assert best.log_likelihood == pytest.approx(log_likelihood)
    assert best.aic == pytest.approx(6 - 2 * log_likelihood)
    assert best.bic == pytest.approx(3 * np.log(counts.sum()) - 2 * log_likelihood)
    with pytest.raises(ValueError, match="at least two"):
        compare_fits({"one": plain})
    with pytest.raises(ValueError, match="of different samples"):
        compare_fits({"one": plain, "other": refit(plain, plain.dataset.measured + 1.0)})


def test_cross_validation(plain):
    left_out = cross_validate(plain)
    assert [prediction.log for prediction in left_out] == ["run 0", "run 1", "run 2"]
    ratios = np.array([prediction.residual_ratio[0] for prediction in left_out])
    np.testing.assert_allclose(ratios, 1.0, atol=0.3)
    assert left_out[0].verdict.startswith("run 0: predicted; residuals are ")
    measured = np.array(plain.dataset.measured)
    measured[2] *= 1.3  # an effect that the model does not have
    verdicts = [prediction.verdict for prediction in cross_validate(refit(plain, measured))]
    assert "run 2: not predicted" in verdicts[2]
    with pytest.raises(ValueError, match="at least two"):
        cross_validate(fit(least_squares(logs=1)))


def test_prediction_of_held_out_logs(plain, monkeypatch):
    measured = clean() + NOISE * np.random.default_rng(9).normal(size=(3, 120, 1))
    measured[1] += 0.1
    data = dataset(measured=measured)
    monkeypatch.setattr(model_validation, "make_dataset", lambda case, logs: data)
    good, bad, _ = model_validation.predict_held_out(plain, data.logs)
    assert good.residual_ratio[0] == pytest.approx(1.0, abs=0.25)
    assert ": predicted; " in good.verdict
    assert bad.residual_ratio[0] == pytest.approx(np.hypot(1, 0.1 / NOISE), rel=0.1)
    assert ": not predicted; " in bad.verdict


# Profiles.


def test_the_profile_of_a_linear_parameter_is_a_parabola(plain):
    offset_profile = profile(plain, "sensors.0.offset")
    error, centre = plain.errors[2], offset_profile.values[offset_profile.deviance.argmin()]
    assert abs(centre - plain.values[2]) < 0.1 * error
    expected = ((offset_profile.values - centre) / error) ** 2
    np.testing.assert_allclose(offset_profile.deviance, expected, rtol=0.02, atol=1e-6)
    np.testing.assert_allclose(offset_profile.interval, plain.intervals[2], atol=0.1 * error)
    assert offset_profile.verdict.endswith("as the linearised fit says")
    assert offset_profile.critical_deviance == pytest.approx(
        t_quantile(plain.degrees_of_freedom) ** 2
    )


def test_a_parameter_at_its_bound_has_a_profile_on_one_side():
    """Damping far below its error: only an upper limit is identifiable."""
    undamped = np.array([formula(20.0, 1e-5, 0.2, amplitude) for amplitude in AMPLITUDES])[
        ..., None
    ]
    noise = NOISE * np.random.default_rng(1).normal(size=undamped.shape)
    damping_profile = profile(fit(least_squares(measured=undamped + noise)), "beam.damping_ratio")
    assert damping_profile.interval[0] == -np.inf and 0.0 < damping_profile.interval[1] < 1.0
    assert damping_profile.verdict.startswith("the data only say that beam.damping_ratio is below ")


def test_the_profile_of_a_parameter_that_is_not_free(plain):
    with pytest.raises(ValueError, match="beam.length is not free in this fit; free are beam"):
        profile(plain, "beam.length")


# Posterior.


def test_the_sampler_draws_from_a_known_density(tmp_path):
    """Two correlated normal variables; a stopped sampling is resumed to the same draws."""
    pytest.importorskip("blackjax")
    covariance = np.array([[1.0, 0.6], [0.6, 1.5]])
    inverse = jnp.linalg.inv(covariance)

    def density(z):
        return -z @ inverse @ z / 2

    arguments = (density, 2, 400, 2, 100, 0)
    draws, divergences = draw_by_nuts(*arguments)
    posterior = with_diagnostics(["a", "b"], draws, divergences)
    np.testing.assert_allclose(np.cov(draws.reshape(-1, 2).T), covariance, atol=0.25)
    np.testing.assert_allclose(posterior.means, 0.0, atol=0.2)
    assert posterior.verdict.startswith("mixed: R-hat up to ") and divergences == 0
    file = tmp_path / "draws.npz"
    first, _ = draw_by_nuts(density, 2, 100, 2, 100, 0, Checkpoint(file, "this"))
    np.testing.assert_array_equal(first, draws[:, :100])
    resumed, _ = draw_by_nuts(*arguments, Checkpoint(file, "this"))
    np.testing.assert_array_equal(resumed, draws)
    with pytest.raises(ValueError, match="belongs to another search"):
        draw_by_nuts(*arguments, Checkpoint(file, "that"))


def test_a_checkpoint_is_not_overwritten(plain, tmp_path):
    file = tmp_path / "draws.npz"
    file.touch()
    with pytest.raises(FileExistsError, match="exists: resume that search, or delete it"):
        sample(plain, checkpoint=file)


def test_verdicts_on_chains_that_do_not_mix():
    pytest.importorskip("blackjax")
    apart = np.random.default_rng(0).normal(size=(2, 300, 1)) + np.array([[[0.0]], [[5.0]]])
    assert "the chains have not mixed" in with_diagnostics(["a"], apart, 0).verdict
    few = np.random.default_rng(0).normal(size=(2, 20, 1))
    assert "effective draws: draw more" in with_diagnostics(["a"], few, 0).verdict
    divergent = np.random.default_rng(0).normal(size=(2, 300, 1))
    assert "100 divergent steps" in with_diagnostics(["a"], divergent, 100).verdict


def test_draws_as_inference_data_and_as_a_table():
    pytest.importorskip("blackjax")
    draws = np.random.default_rng(0).normal(size=(2, 300, 2))
    posterior = with_diagnostics(["beam.length", "loads.0.mass"], draws, 0)
    tree = posterior.to_inference_data()
    group = tree["posterior"]
    assert list(tree.children) == ["posterior"] and dict(group.sizes) == {"chain": 2, "draw": 300}
    np.testing.assert_array_equal(group["loads.0.mass"], draws[..., 1])
    frame = posterior.to_dataframe()
    np.testing.assert_allclose(frame["mean"], draws.mean(axis=(0, 1)))
    assert f"{draws[..., 0].mean():.6g}</td>" in posterior._repr_html_()


def test_the_posterior_of_a_fit_is_as_wide_as_its_intervals(plain):
    """The model is nearly linear within its errors, so that both agree."""
    pytest.importorskip("blackjax")
    posterior = sample(plain, draws=300, chains=2, warmup=100)
    np.testing.assert_allclose(posterior.deviations, plain.errors, rtol=0.2)
    assert np.all(np.abs(posterior.means - plain.values) < 0.3 * plain.errors)
    assert str(posterior).splitlines()[1].startswith("beam.flexural_rigidity ")


def test_unknown_noise_levels_are_integrated_out():
    """Twelve samples: against the integral over the level, by quadrature."""
    mask = np.zeros((1, TIMES.size, 1))
    mask[0, :12] = 1.0
    offset_fit = fit(least_squares({"sensors.0.offset": None}, logs=1, mask=mask))
    density, _, start, whitening = _log_density(offset_fit, "estimated")
    points = np.linspace(-4.0, 4.0, 9)
    log_densities = np.array([density(jnp.array([point])) for point in points])
    offsets = start[0] + whitening[0, 0] * points
    deviations = (dataset(logs=1).measured - clean(1))[0, :12, 0] + TRUTH["sensors.0.offset"]
    count = 12 / offset_fit.autocorrelation_factor[0, 0]

    def evidence(offset):
        squares = np.sum((deviations - offset) ** 2) / offset_fit.autocorrelation_factor[0, 0]
        return quad(
            lambda s: np.exp(-(count + 1) * np.log(s / NOISE) - squares / (2 * s**2)),
            NOISE / 10,
            50 * NOISE,
            limit=200,
            points=[NOISE],
        )[0]

    expected = np.log([evidence(offset) for offset in offsets])
    np.testing.assert_allclose(log_densities - log_densities[4], expected - expected[4], atol=1e-3)
    # Wider than with fixed noise: the tails of Student's distribution.
    fixed = _log_density(offset_fit)[0]
    assert log_densities[-1] - log_densities[4] > float(
        fixed(jnp.array([4.0])) - fixed(jnp.array([0.0]))
    )


def test_unknown_noise_models_are_refused(plain):
    with pytest.raises(ValueError, match="noise can be 'fixed' or 'estimated', not 'free'"):
        sample(plain, noise="free")


def test_unidentifiable_directions_are_not_sampled(plain):
    blind = dataclasses.replace(plain, unidentifiable=[{"beam.damping_ratio": 0.1}])
    with pytest.raises(
        ValueError, match="not identifiable from the data: beam.damping_ratio; give a prior"
    ):
        sample(blind)


# Storage.


def test_a_fit_is_stored_without_loss(plain, tmp_path, monkeypatch):
    # The stand-in is made again, as the dataset of real logs would be.
    monkeypatch.setattr(result, "make_dataset", lambda case, logs: dataset())
    result.save_fit(plain, tmp_path / "fit.npz")
    again = result.load_fit(tmp_path / "fit.npz")
    assert str(again) == str(plain)
    for name in ("values", "errors", "correlation", "fitted", "noise", "intervals"):
        np.testing.assert_array_equal(getattr(again, name), getattr(plain, name))
    np.testing.assert_allclose(
        again.least_squares.solve(again.dataset.measured).values, plain.values, rtol=1e-12
    )
    with pytest.raises(FileExistsError, match="exists already"):
        result.save_fit(plain, tmp_path / "fit.npz")
    with pytest.raises(ValueError, match="there is no such fit"):
        result.load_fit(tmp_path / "other.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "fit.npz").read_bytes()[:900])
    with pytest.raises(ValueError, match="this NumPy archive is damaged or cut off"):
        result.load_fit(tmp_path / "cut.npz")


def test_fits_of_the_former_format_are_refused(plain, tmp_path):
    file = tmp_path / "fit.npz"
    save(file, result.FORMER_FORMAT, {"about": np.array("{}")})
    with pytest.raises(ValueError, match="written by jaxbeam 0.1: identify from the logs again"):
        result.load_fit(file)


def test_logs_are_stored_with_their_loads():
    loads = (jb.MovingMass(mass=0.5, speed=-1.0, entry_time=0.1), jb.MovingForce(force=3, speed=2))
    log = dataclasses.replace(dataset().logs[0], loads=loads, notes=("half of it",), sensors=(0,))
    about = json.loads(json.dumps(result._log_header(log, CASE)))
    arrays = {f"log0.{name}": getattr(log, name) for name in ("times", "values", "valid")}
    again = result._read_log(0, about, case_to_dict(CASE)["beam"], arrays)
    assert eqx.tree_equal(again.loads, loads)
    for name in ("names", "units", "sensors", "notes", "source"):
        assert getattr(again, name) == getattr(log, name)


# Model selection by information criteria: an elastic support of span two, and a delayed actuator.
#
# A finite-element rig has both effects, and the criteria select the model with both.

DELAY = 4e-3  # s
STIFF, PROMPT = 1e7, 1e4  # N/m and 1/s: without either effect
BANDWIDTH, SUPPORT = "actuators.0.bandwidth", "supports.1.stiffness"


@pytest.fixture(scope="module")
def identification() -> SimulatedIdentification:
    """A delayed shaker on the second span, whose outer support is elastic."""
    rig = plant(
        2,
        11.68,
        0.535,
        [jb.Shaker(**(SHAKER | {"position": 0.9}))],
        [finite_elements.Suspension(0.9, *list(SHAKER.values())[1:3])],
        {0.6: 1e7, 1.2: SAGGING},
        [(0.3,), (0.9,)],
        modes=5,
        ends="pinned-free",
    )
    delayed = dataclasses.replace(rig, case=replace(rig.case, {BANDWIDTH: 1 / DELAY}))
    truth = {name: rig.truth[name] for name in ("beam.flexural_rigidity", SUPPORT)}
    return SimulatedIdentification(
        dataclasses.replace(delayed, truth=truth | {BANDWIDTH: 1 / DELAY})
    )


def test_criteria_select_elastic_supports_and_delayed_actuators(identification):
    noise = np.random.default_rng(0).normal(size=identification.clean.shape)
    names = list(identification.truth)
    held = identification.truth | {SUPPORT: STIFF, BANDWIDTH: PROMPT}
    point = to_unbounded(identification.parameters, [held[name] for name in names])
    models = {
        "neither": [names[0]],
        "sags": [names[0], SUPPORT],
        "late": [names[0], BANDWIDTH],
        "both": names,
    }
    fits, summaries = {}, {}
    for name, free in models.items():
        free = np.array([address in free for address in names])
        fit = identification.result(noise, identification.fit(noise, free, point))
        summaries[name] = str(fit)
        moving = [p for p, moves in zip(identification.parameters, free, strict=True) if moves]
        fits[name] = dataclasses.replace(fit, parameters=moving)
    ranked = compare_fits(fits)
    assert ranked[0].name == "both" and ranked[-1].name == "neither"
    assert ranked[1].bic - ranked[0].bic > 10 and ranked[0].weight > 0.99
    values = dict(zip(names, fits["both"].values, strict=True))
    assert values[SUPPORT] == pytest.approx(SAGGING, rel=0.05)
    # The model has a lag in place of the pure delay; they agree at low frequencies only.
    assert 1 / values[BANDWIDTH] == pytest.approx(DELAY, rel=0.2)
    assert "unreliable" in summaries["sags"] and "unreliable" in summaries["late"]


# Summary, remarks and report of a fit.


def test_a_report_with_all_sections(plain, tmp_path):
    minima = tuple(LocalMinimum(cost, plain.values, plain.values, 3, True) for cost in (1.5, 40.0))
    with_minima = dataclasses.replace(plain, minima=minima)
    values = np.linspace(0.19, 0.21, 5)
    offset = Profile("sensors.0.offset", "m", values, (values - 0.2) ** 2 * 1e5, 4.0,
                     (0.195, np.inf), (0.194, 0.206))  # fmt: skip
    draws = plain.values + plain.errors * np.random.default_rng(0).normal(size=(2, 50, 3))
    held = plain.least_squares.solve(plain.dataset.measured, free=np.array([True, False, True]))
    worse = dataclasses.replace(plain, fitted=held.predicted, parameters=plain.parameters[:2])
    write_report(
        tmp_path / "report",
        with_minima,
        profiles=[offset],
        posterior=with_diagnostics(plain.addresses, draws, 0),
        held_out=cross_validate(plain),
        models=compare_fits({"free": plain, "held & <fast>": worse}),
    )
    text = (tmp_path / "report" / "report.md").read_text()
    page = (tmp_path / "report" / "report.html").read_text()
    for heading in ("Parameters", "Remarks", "Measured and fitted", "Correlations", "Profiles",
                    "Posterior", "Held-out logs", "Models compared"):  # fmt: skip
        assert f"## {heading}\n" in text and f"<h2>{heading}</h2>" in page
    assert "the data only say that sensors.0.offset is above 0.195 m." in text
    assert re.search(r"\| beam.flexural_rigidity \| N m\^2 \| 19 \|  \| 20\.\d+ \| 0\.\d+ \|", text)
    assert "<td>held &amp; &lt;fast&gt;</td>" in page
    assert "2 minima from 6 starts:\n  misfit 1.5 from 3 starts: " in str(with_minima)
    for name in re.findall(r"!\[.*\]\((.*)\)", text):
        assert (tmp_path / "report" / name).stat().st_size > 1000
        assert f'src="{name}"' in page
    with pytest.raises(FileExistsError, match="report is not empty; choose another"):
        write_report(tmp_path / "report", plain)


def test_remarks_on_priors_and_on_logs():
    measured = clean() + NOISE * np.random.default_rng(0).normal(size=clean().shape)
    measured[1, 60] += 2.0
    prior = {"beam.damping_ratio": Prior(mean=0.03, deviation=1e-5)}
    fitted = fit(least_squares(measured=measured, free=dict.fromkeys(TRUTH) | prior))
    remarks = "\n".join(fitted.remarks)
    assert "beam.damping_ratio is determined by its prior more than by the logs" in remarks
    assert "run 1: w has spikes (1 sample), first at t = 1.2 s (not masked)" in remarks

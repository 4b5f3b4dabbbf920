"""A written account of an identification: Markdown and HTML, with tables and figures."""

import os
from collections.abc import Sequence

import numpy as np

from jaxbeam.files.report import (
    ReportFigure,
    ReportSection,
    ReportTable,
    write_report as write_files,
)
from tuning.fit.identify import Fit
from tuning.fit.model_validation import HeldOutPrediction, ModelCriteria, channel_residuals
from tuning.fit.summary import remarks
from tuning.fit.uncertainty.posterior import Posterior
from tuning.fit.uncertainty.profile import Profile


def write_report(
    folder: str | os.PathLike,
    fit: Fit,
    *,
    profiles: Sequence[Profile] = (),
    posterior: Posterior | None = None,
    held_out: Sequence[HeldOutPrediction] = (),
    models: Sequence[ModelCriteria] = (),
    overwrite: bool = False,
) -> None:
    """Write report.md, report.html and their pictures to a folder.

    Raises FileExistsError if the folder is not empty and `overwrite` is not set.
    """
    sections = report_sections(fit, profiles, posterior, held_out, models)
    title = fit.case.title or "Identification"
    write_files(folder, title, sections, overwrite=overwrite)


def report_sections(
    fit: Fit,
    profiles: Sequence[Profile] = (),
    posterior: Posterior | None = None,
    predictions: Sequence[HeldOutPrediction] = (),
    models: Sequence[ModelCriteria] = (),
) -> list[ReportSection]:
    """What is to be told of a fit, section by section."""
    from tuning.fit.plots import plot_posterior, plot_profiles

    sections = [
        ReportSection("Numbers", [fit.verdict + ".", _parameter_table(fit), *_minima_table(fit)]),
        ReportSection("Remarks", remarks(fit)),
        ReportSection(
            "Measured and fitted", [ReportFigure("fit", fit.plot()), _residual_table(fit)]
        ),
    ]
    if len(fit.parameters) > 1:
        sections.append(ReportSection("Correlations", [_correlation_table(fit)]))
    if profiles:
        verdicts = [found.verdict + "." for found in profiles]
        sections.append(
            ReportSection(
                "Profiles", [*verdicts, ReportFigure("profiles", plot_profiles(profiles))]
            )
        )
    if posterior:
        parts = [posterior.verdict + ".", _posterior_table(posterior)]
        sections.append(
            ReportSection(
                "Posterior", [*parts, ReportFigure("posterior", plot_posterior(posterior))]
            )
        )
    if predictions:
        sections.append(
            ReportSection("Logs left out", [found.verdict + "." for found in predictions])
        )
    if models:
        sections.append(ReportSection("Rival models", [_model_table(models)]))
    return sections


def _parameter_table(fit: Fit) -> ReportTable:
    rows = []
    for number, value, error, (low, high) in zip(
        fit.parameters, fit.values, fit.errors, fit.intervals, strict=True
    ):
        identifiable = np.isfinite(error)
        interval = f"{low:.5g} to {high:.5g}" if identifiable else "the data cannot tell"
        prior = number.prior
        prior_text = "" if prior.mean is None else f"{prior.mean:.5g} ± {prior.deviation:.3g}"
        rows.append(
            (
                number.address,
                number.unit,
                f"{number.start:.5g}",
                prior_text,
                f"{value:.6g}",
                f"{error:.2g}" if identifiable else "",
                interval,
            )
        )
    header = ("number", "unit", "start", "prior", "fitted", "standard error", "95 % interval")
    return ReportTable(header, rows)


def _minima_table(fit: Fit) -> list[ReportTable]:
    if not fit.minima:
        return []
    rows = [
        (f"{found.cost:.6g}", str(found.starts), *(f"{value:.5g}" for value in found.values))
        for found in fit.minima
    ]
    return [ReportTable(("misfit", "starts", *fit.addresses), rows)]


def _residual_table(fit: Fit) -> ReportTable:
    rows = [
        (
            fit.dataset.logs[found.log].source,
            str(found.sensor),
            f"{found.noise:.3g}",
            f"{found.p_value:.2g}",
            f"{found.autocorrelation_factor:.3g}",
            f"{1e3 * found.time_shift:.2g} ± {2e3 * found.time_shift_sd:.2g}",
        )
        for found in channel_residuals(fit)
    ]
    header = ("log", "sensor", "residual (SI)", "chance of such colour", "variances times")
    return ReportTable((*header, "late by (ms)"), rows)


def _correlation_table(fit: Fit) -> ReportTable:
    rows = []
    for address, row in zip(fit.addresses, fit.correlation, strict=True):
        cells = ("" if np.isnan(entry) else f"{entry:.2f}" for entry in row)
        rows.append((address, *cells))
    return ReportTable(("", *fit.addresses), rows)


def _posterior_table(posterior: Posterior) -> ReportTable:
    columns = zip(
        posterior.addresses,
        posterior.means,
        posterior.deviations,
        posterior.intervals,
        posterior.r_hat,
        posterior.effective_draws,
        strict=True,
    )
    rows = [
        (address, f"{mean:.6g}", f"{sd:.2g}", f"{low:.5g} to {high:.5g}", f"{r:.3f}", f"{n:.0f}")
        for address, mean, sd, (low, high), r, n in columns
    ]
    header = ("number", "mean", "deviation", "95 % interval", "R-hat", "effective draws")
    return ReportTable(header, rows)


def _model_table(models: Sequence[ModelCriteria]) -> ReportTable:
    rows = [
        (r.name, str(r.parameter_count), f"{r.log_likelihood:.2f}", f"{r.aic:.2f}", f"{r.bic:.2f}",
         f"{r.weight:.2g}")
        for r in models
    ]  # fmt: skip
    return ReportTable(("model", "free numbers", "ln L", "AIC", "BIC", "weight"), rows)

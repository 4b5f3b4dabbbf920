"""A written account of an identification: Markdown and HTML, with tables and figures."""

import html as escaping
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxbeam.files.report import html_table, markdown_table, page
from tuning.fit.identify import Fit
from tuning.fit.model_validation import Rival, Unseen, channels
from tuning.fit.summary import remarks
from tuning.fit.uncertainty.posterior import Posterior
from tuning.fit.uncertainty.profile import Profile


class Table(NamedTuple):
    """A table of an account."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]


class Picture(NamedTuple):
    """A figure of an account, and the name of its file without the suffix."""

    name: str
    figure: Any  # of matplotlib, which is imported only where something is drawn


class Section(NamedTuple):
    """A heading and what is below it: sentences, tables and pictures."""

    title: str
    parts: list[str | Table | Picture]


def write_report(
    folder: str | os.PathLike,
    fit: Fit,
    *,
    profiles: Sequence[Profile] = (),
    posterior: Posterior | None = None,
    unseen: Sequence[Unseen] = (),
    rivals: Sequence[Rival] = (),
    overwrite: bool = False,
) -> None:
    """Write report.md, report.html and their pictures to a folder.

    Raises FileExistsError if the folder is not empty and `overwrite` is not set.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()) and not overwrite:
        raise FileExistsError(f"the folder {folder} is not empty; choose another, or overwrite it")
    folder.mkdir(parents=True, exist_ok=True)
    sections = account(fit, profiles, posterior, unseen, rivals)
    for section in sections:
        for part in section.parts:
            if isinstance(part, Picture):
                part.figure.savefig(folder / f"{part.name}.png")
    title = fit.case.title or "Identification"
    (folder / "report.md").write_text(markdown(title, sections), encoding="utf-8")
    (folder / "report.html").write_text(html(title, sections), encoding="utf-8")


def account(
    fit: Fit,
    profiles: Sequence[Profile] = (),
    posterior: Posterior | None = None,
    unseen: Sequence[Unseen] = (),
    rivals: Sequence[Rival] = (),
) -> list[Section]:
    """What is to be told of a fit, section by section."""
    from tuning.fit.plots import plot_posterior, plot_profiles

    sections = [
        Section("Numbers", [fit.verdict + ".", _numbers(fit), *_minima(fit)]),
        Section("Remarks", remarks(fit)),
        Section("Measured and fitted", [Picture("fit", fit.plot()), _residuals(fit)]),
    ]
    if len(fit.numbers) > 1:
        sections.append(Section("Correlations", [_correlations(fit)]))
    if profiles:
        words = [found.verdict + "." for found in profiles]
        sections.append(Section("Profiles", [*words, Picture("profiles", plot_profiles(profiles))]))
    if posterior:
        parts = [posterior.verdict + ".", _draws(posterior)]
        sections.append(
            Section("Posterior", [*parts, Picture("posterior", plot_posterior(posterior))])
        )
    if unseen:
        sections.append(Section("Logs left out", [found.verdict + "." for found in unseen]))
    if rivals:
        sections.append(Section("Rival models", [_rivals(rivals)]))
    return sections


def markdown(title: str, sections: Sequence[Section]) -> str:
    """The account in Markdown, pictures beside it."""
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for part in section.parts:
            if isinstance(part, Table):
                lines += markdown_table(*part)
            elif isinstance(part, Picture):
                lines += [f"![{part.name}]({part.name}.png)", ""]
            else:
                lines += [part, ""]
    return "\n".join(lines)


def html(title: str, sections: Sequence[Section]) -> str:
    """The account as a page, pictures beside it."""
    safe = escaping.escape
    body = [f"<h1>{safe(title)}</h1>"]
    for section in sections:
        body.append(f"<h2>{safe(section.title)}</h2>")
        for part in section.parts:
            if isinstance(part, Table):
                body.append(html_table(*part))
            elif isinstance(part, Picture):
                body.append(f'<img src="{part.name}.png" alt="{part.name}">')
            else:
                body.append(f"<p>{safe(part)}</p>")
    return page(title, body)


def _numbers(fit: Fit) -> Table:
    rows = []
    for number, value, error, (low, high) in zip(
        fit.numbers, fit.values, fit.errors, fit.intervals, strict=True
    ):
        told = np.isfinite(error)
        interval = f"{low:.5g} to {high:.5g}" if told else "the data cannot tell"
        prior = number.belief
        believed = "" if prior.mean is None else f"{prior.mean:.5g} ± {prior.deviation:.3g}"
        rows.append(
            (
                number.address,
                number.unit,
                f"{number.start:.5g}",
                believed,
                f"{value:.6g}",
                f"{error:.2g}" if told else "",
                interval,
            )
        )
    header = ("number", "unit", "start", "prior", "fitted", "standard error", "95 % interval")
    return Table(header, rows)


def _minima(fit: Fit) -> list[Table]:
    if not fit.minima:
        return []
    rows = [
        (f"{found.cost:.6g}", str(found.starts), *(f"{value:.5g}" for value in found.values))
        for found in fit.minima
    ]
    return [Table(("misfit", "starts", *fit.addresses), rows)]


def _residuals(fit: Fit) -> Table:
    rows = [
        (
            fit.campaign.logs[found.log].source,
            str(found.sensor),
            f"{found.noise:.3g}",
            f"{found.probability:.2g}",
            f"{found.colour:.3g}",
            f"{1e3 * found.shift:.2g} ± {2e3 * found.shift_error:.2g}",
        )
        for found in channels(fit)
    ]
    header = ("log", "sensor", "residual (SI)", "chance of such colour", "variances times")
    return Table((*header, "late by (ms)"), rows)


def _correlations(fit: Fit) -> Table:
    rows = []
    for address, row in zip(fit.addresses, fit.correlation, strict=True):
        cells = ("" if np.isnan(entry) else f"{entry:.2f}" for entry in row)
        rows.append((address, *cells))
    return Table(("", *fit.addresses), rows)


def _draws(posterior: Posterior) -> Table:
    columns = zip(
        posterior.addresses,
        posterior.means,
        posterior.deviations,
        posterior.intervals,
        posterior.r_hat,
        posterior.effective,
        strict=True,
    )
    rows = [
        (address, f"{mean:.6g}", f"{sd:.2g}", f"{low:.5g} to {high:.5g}", f"{r:.3f}", f"{n:.0f}")
        for address, mean, sd, (low, high), r, n in columns
    ]
    header = ("number", "mean", "deviation", "95 % interval", "R-hat", "effective draws")
    return Table(header, rows)


def _rivals(rivals: Sequence[Rival]) -> Table:
    rows = [
        (r.name, str(r.numbers), f"{r.log_likelihood:.2f}", f"{r.aic:.2f}", f"{r.bic:.2f}",
         f"{r.weight:.2g}")
        for r in rivals
    ]  # fmt: skip
    return Table(("model", "free numbers", "ln L", "AIC", "BIC", "weight"), rows)

"""The validation page: errors of jaxbeam against independent sources, computed when written."""

import platform
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path

from experiments.validation.check import Check
from jaxbeam.files.report import ReportSection, ReportTable, markdown
from jaxbeam.simulation.simulate import ContactLossWarning

PAGE_FILE = Path(__file__).parents[2] / "VALIDATION.md"
INTRODUCTION = """Each row compares jaxbeam with a reference that shares no code with it: closed
forms, finite elements, scipy, another solver. Errors are relative, and were computed when this page
was written, by

    .venv/bin/uv run python -m experiments.validation

which fails if an error exceeds its tolerance. The references are in `tests/oracles`; the tests
compare many more cases with them."""


def check_groups() -> tuple[Callable[[], Iterator[Check]], ...]:
    """Functions that yield the checks of a group, whose title is their docstring.

    Raises RuntimeError outside a clone of the repository, whose tests have the references.
    """
    try:
        from experiments.validation import control_checks, crossing_checks
    except ModuleNotFoundError as error:
        raise RuntimeError(
            f"the references are in the repository, not in the package ({error});"
            " run this from the root of a clone"
        ) from None
    return (
        crossing_checks.frequencies,
        crossing_checks.statics,
        crossing_checks.crossings,
        crossing_checks.energy,
        crossing_checks.gradients,
        control_checks.loops,
        control_checks.bounds,
    )


def run_checks() -> list[tuple[str, list[Check]]]:
    """Titles and checks of all groups; prints the wall time of each group."""
    results = []
    with warnings.catch_warnings():
        # Moving masses that would lift off solve the same equations.
        warnings.simplefilter("ignore", ContactLossWarning)
        for group in check_groups():
            start = time.perf_counter()
            results.append((str(group.__doc__).rstrip("."), list(group())))
            print(f"{group.__name__}: {time.perf_counter() - start:.0f} s", flush=True)
    return results


def validation_page(groups: Sequence[tuple[str, Sequence[Check]]]) -> str:
    """The page in Markdown: a table for each group of checks."""
    checks = [check for _, group in groups for check in group]
    passed = sum(check.passed for check in checks)
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jaxbeam", "jax", "scipy"))
    summary = (
        f"**{passed} of {len(checks)} errors are within their tolerances**"
        f" ({versions}, Python {platform.python_version()})."
    )
    sections = [ReportSection("", [INTRODUCTION, summary])]
    for title, group in groups:
        rows = [
            (
                check.quantity,
                check.reference,
                f"{check.error:.1e}",
                f"{check.tolerance:.0e}",
                "within" if check.passed else "**above**",
            )
            for check in group
        ]
        header = ("quantity", "reference", "error", "tolerance", "")
        sections.append(ReportSection(title, [ReportTable(header, rows)]))
    return markdown("Validation", sections)

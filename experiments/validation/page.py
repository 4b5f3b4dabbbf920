"""The validation page: errors of jaxbeam against independent sources, computed when written."""

import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxbeam.files.report import ReportSection, ReportTable, markdown

PAGE_FILE = Path(__file__).parents[2] / "VALIDATION.md"
INTRODUCTION = """Each row compares jaxbeam with a reference that shares no code with it: closed
forms, finite elements, scipy, another solver. Errors are relative, and were computed when this page
was written, by

    .venv/bin/uv run python -m experiments.validation

which fails if an error exceeds its tolerance. The references are in `tests/oracles`; the tests
compare many more cases with them."""


class Check(NamedTuple):
    """A quantity computed by jaxbeam, a reference, and the relative error beside its tolerance."""

    quantity: str
    reference: str
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; NaN is not."""
        return self.error <= self.tolerance


def max_relative_error(computed, expected) -> float:
    """Largest difference over the largest expected value."""
    computed, expected = np.asarray(computed), np.asarray(expected)
    return float(np.max(np.abs(computed - expected)) / np.max(np.abs(expected)))


def max_entrywise_error(computed, expected) -> float:
    """Largest difference of any entry over that entry."""
    return float(np.max(np.abs(np.asarray(computed) / np.asarray(expected) - 1)))


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

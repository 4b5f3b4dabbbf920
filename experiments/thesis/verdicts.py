"""Published numbers, their tolerances, and the verdict on each: reproduced, explained, or not.

A verdict is computed from the tolerance of the published number.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Allowed difference from a published number: the largest of three bounds.

    `relative` is a share of the number, `absolute` is in its unit, `digits` counts units of its
    last printed digit (zeros at the end of a whole number are not digits). `basis` names the kind
    of number that the tolerance is for.
    """

    basis: str
    relative: float = 0.0
    absolute: float = 0.0
    digits: float = 0.0

    def __str__(self) -> str:
        parts = [f"{self.absolute:g}"] if self.absolute else []
        parts += [f"{100 * self.relative:g} %"] if self.relative else []
        parts += [f"{self.digits:g} in the last digit"] if self.digits else []
        return " or ".join(parts)


@dataclasses.dataclass(frozen=True)
class PublishedNumbers:
    """Published numbers of one quantity: location, unit, origin, tolerance, and the digits.

    `printed_text` holds the numbers as printed, separated by spaces, and `labels` a name for each.
    `origin` is "measured" or "computed", as the thesis says. `interpretation` says how an ambiguous
    statement is read.
    """

    location: str
    quantity: str
    unit: str
    origin: str
    tolerance: Tolerance
    printed_text: str
    labels: str = ""
    interpretation: str = ""

    @property
    def numbers(self) -> np.ndarray:
        """The values, (number,)."""
        return np.array([float(word) for word in self.printed_text.split()])

    @property
    def allowed_error(self) -> np.ndarray:
        """Allowed absolute difference from each value, (number,)."""
        last_digits = [_last_digit_unit(word) for word in self.printed_text.split()]
        by_digits = self.tolerance.digits * np.array(last_digits)
        by_share = self.tolerance.relative * np.abs(self.numbers)
        return np.maximum(np.maximum(by_share, by_digits), self.tolerance.absolute)

    @property
    def value_labels(self) -> list[str]:
        """One label for each value, empty where none is given."""
        labels = self.labels.split()
        return labels or [""] * self.numbers.size


def _last_digit_unit(word: str) -> float:
    """One unit of the last printed digit; zeros at the end of a whole number are not digits."""
    if "." in word:
        return 10.0 ** -len(word.partition(".")[2])
    return 10.0 ** (len(word) - len(word.rstrip("0")))


REPRODUCED, EXPLAINED = "reproduced", "explained"
IRREPRODUCIBLE, NOT_REPRODUCED = "cannot be reproduced", "not reproduced"
VERDICTS = (REPRODUCED, EXPLAINED, IRREPRODUCIBLE, NOT_REPRODUCED)
LITERAL = "as printed"  # name of the interpretation that takes the thesis at its word


@dataclasses.dataclass(frozen=True)
class Finding:
    """Published numbers beside computed ones, under one or more interpretations of the thesis.

    `interpretations` maps a name to computed values (number,); the first takes the thesis at its
    word, the others are what it may have meant. `inconsistency` is a computed proof that no value
    can be right for the stated rig, or empty.

    Raises ValueError if an interpretation has another count of values than is published.
    """

    published: PublishedNumbers
    interpretations: Mapping[str, np.ndarray]
    inconsistency: str = ""

    def __post_init__(self):
        count = self.published.numbers.size
        for name, values in self.interpretations.items():
            if np.shape(values) != (count,):
                raise ValueError(f"{self.published.location}, {name}: {count} numbers are printed")

    def within_tolerance(self, interpretation: str) -> np.ndarray:
        """Whether each computed number is within the tolerance, (number,)."""
        computed = np.asarray(self.interpretations[interpretation])
        # Differences of decimal numbers are off by rounding: 1.1 - 1.0 exceeds 0.1.
        return np.abs(computed - self.published.numbers) <= self.published.allowed_error * (
            1 + 1e-9
        )


def make_finding(
    published: PublishedNumbers,
    values,
    alternatives: Mapping[str, np.ndarray] | None = None,
    inconsistency: str = "",
) -> Finding:
    """A finding with `values` by the literal interpretation, and `alternatives` by name.

    Values are numbers or arrays (number,). Raises ValueError if their count is not that published.
    """
    interpretations = {LITERAL: values} | dict(alternatives or {})
    arrays = {name: np.atleast_1d(np.asarray(v)) for name, v in interpretations.items()}
    return Finding(published, arrays, inconsistency)


def best_interpretation(findings: Sequence[Finding]) -> str:
    """Name of the alternative with most numbers within tolerance over all findings.

    The findings have the same alternatives, so that one serves for all numbers. Empty if there are
    none.
    """
    alternatives = list(findings[0].interpretations)[1:]
    hits = {
        name: sum(int(one.within_tolerance(name).sum()) for one in findings)
        for name in alternatives
    }
    return max(hits, key=lambda name: hits[name], default="")


class FindingVerdicts(NamedTuple):
    """Verdict on each number of a finding, and the interpretation that it rests on."""

    verdicts: list[str]
    interpretations: list[str]


def assign_verdicts(findings: Sequence[Finding]) -> list[FindingVerdicts]:
    """Verdicts on the numbers of each finding.

    "reproduced": the literal interpretation is within tolerance. "explained": the best alternative
    is, which is the same for all findings that have the same alternatives. Otherwise "cannot be
    reproduced" if the published numbers are inconsistent, else "not reproduced".
    """
    assigned = []
    for one in findings:
        same = [f for f in findings if list(f.interpretations) == list(one.interpretations)]
        literal, alternative = next(iter(one.interpretations)), best_interpretation(same)
        explained = (
            one.within_tolerance(alternative)
            if alternative
            else np.zeros(one.published.numbers.size, bool)
        )
        otherwise = IRREPRODUCIBLE if one.inconsistency else NOT_REPRODUCED
        verdicts = [
            REPRODUCED if by_literal else EXPLAINED if by_alternative else otherwise
            for by_literal, by_alternative in zip(
                one.within_tolerance(literal), explained, strict=True
            )
        ]
        sources = [alternative if word == EXPLAINED else literal for word in verdicts]
        assigned.append(FindingVerdicts(verdicts, sources))
    return assigned


@dataclasses.dataclass(frozen=True)
class ExperimentResult:
    """Result of an experiment: findings, figures by name, and remarks.

    A figure is None after it has been written to a file.
    """

    findings: tuple[Finding, ...]
    figures: Mapping[str, Figure | None]
    remarks: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One table or group of figures of the thesis: its subject, its claim, and its computation.

    `run(load_rig)` computes the result; `load_rig(name)` returns the case of a published rig, as
    `jaxbeam.rigs.load` does.
    """

    name: str
    covers: str
    claim: str
    run: Callable[[Callable[[str], jb.Case]], ExperimentResult]


class ExperimentRun(NamedTuple):
    """An experiment with its result, the verdicts on each finding, and the wall time (s)."""

    experiment: Experiment
    outcome: ExperimentResult
    verdicts: list[FindingVerdicts]
    seconds: float

    def count(self, verdict: str) -> int:
        """Number of published values with this verdict."""
        return sum(one.verdicts.count(verdict) for one in self.verdicts)

"""What a printed number is, and when it counts as reproduced.

A verdict is computed from a tolerance that the printed number carries; nobody types it in.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """How far ours may be from a printed number: the largest of what is given here.

    `relative` is a share of the printed number, `absolute` is in its unit, `digits` in units of
    its last digit (zeros at the end of a whole number are none); `basis` says for what kind of
    number it is.
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
    """Printed numbers of one kind: what, where, and how near ours must come.

    `printed_text` are written as printed, since their digits count; `labels` name them one by one.
    `origin` is "measured" or "computed", by the thesis; `interpretation` is what was chosen where it is
    ambiguous.
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
        """The values as numbers."""
        return np.array([float(word) for word in self.printed_text.split()])

    @property
    def allowed_error(self) -> np.ndarray:
        """How far ours may be from each of the values."""
        last = self.tolerance.digits * np.array(
            [_last_digit_unit(w) for w in self.printed_text.split()]
        )
        wide = self.tolerance.relative * np.abs(self.numbers)
        return np.maximum(np.maximum(wide, last), self.tolerance.absolute)

    @property
    def value_labels(self) -> list[str]:
        """A label for each value."""
        labels = self.labels.split()
        return labels or [""] * self.numbers.size


def _last_digit_unit(word: str) -> float:
    """One unit of the last digit of a number; zeros at the end of a whole number are none."""
    if "." in word:
        return 10.0 ** -len(word.partition(".")[2])
    return 10.0 ** (len(word) - len(word.rstrip("0")))


REPRODUCED, EXPLAINED = "reproduced", "explained"
IRREPRODUCIBLE, NOT_REPRODUCED = "cannot be reproduced", "not reproduced"
VERDICTS = (REPRODUCED, EXPLAINED, IRREPRODUCIBLE, NOT_REPRODUCED)


@dataclasses.dataclass(frozen=True)
class Finding:
    """Printed numbers beside ours, by one reading of the thesis or by several.

    The first of the `interpretations` is what the thesis says; the others are what it may have meant,
    each named by a reason. `inconsistency` is why the numbers cannot be right for the rig that is
    stated, if a computation has shown that, else empty.
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
        """Whether each number of a reading is as near as it must be."""
        # The last bit of a difference of rounded numbers does not count.
        far = np.abs(np.asarray(self.interpretations[interpretation]) - self.published.numbers)
        return far <= self.published.allowed_error * (1 + 1e-9)


def make_finding(
    published: PublishedNumbers,
    values,
    alternatives: Mapping[str, np.ndarray] | None = None,
    inconsistency: str = "",
) -> Finding:
    """A finding by the reading as printed, and by `alternatives`, each named by what it takes instead."""
    readings = {"as printed": values} | dict(alternatives or {})
    return Finding(
        published, {k: np.atleast_1d(np.asarray(v)) for k, v in readings.items()}, inconsistency
    )


def best_interpretation(findings: Sequence[Finding]) -> str:
    """Of the other readings that findings have in common, the one that meets most numbers.

    One reading has to serve for all: no number gets one of its own. Empty if there is no other.
    """
    others = list(findings[0].interpretations)[1:]
    hits = {name: sum(int(one.within_tolerance(name).sum()) for one in findings) for name in others}
    return max(hits, key=lambda name: hits[name], default="")


class FindingVerdicts(NamedTuple):
    """Verdicts on the numbers of a finding, and for each the reading of ours it rests on."""

    verdicts: list[str]
    interpretations: list[str]


def assign_verdicts(findings: Sequence[Finding]) -> list[FindingVerdicts]:
    """The verdicts on the numbers of each finding.

    Reproduced: the reading as printed is within the tolerance. Explained: another reading is, the
    same for all findings that offer the same ones. Otherwise it cannot be reproduced, if there is
    an obstacle, or is not.
    """
    judged = []
    for one in findings:
        alike = [
            other for other in findings if list(other.interpretations) == list(one.interpretations)
        ]
        first, second = next(iter(one.interpretations)), best_interpretation(alike)
        explained = (
            one.within_tolerance(second) if second else np.zeros(one.published.numbers.size, bool)
        )
        words = [
            REPRODUCED
            if plain
            else EXPLAINED
            if other
            else IRREPRODUCIBLE
            if one.inconsistency
            else NOT_REPRODUCED
            for plain, other in zip(one.within_tolerance(first), explained, strict=True)
        ]
        judged.append(
            FindingVerdicts(words, [second if word == EXPLAINED else first for word in words])
        )
    return judged


@dataclasses.dataclass(frozen=True)
class ExperimentResult:
    """What an experiment found: numbers beside printed ones, figures by name, remarks."""

    findings: tuple[Finding, ...]
    figures: Mapping[str, Figure | None]  # None once drawn to a file
    remarks: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One table or group of figures of the thesis: what it claims, and how that is computed.

    `run` is given what loads a rig by its name, `jaxbeam.rigs.load` or something in its place.
    """

    name: str
    covers: str
    claim: str
    run: Callable[[Callable[[str], jb.Case]], ExperimentResult]


class Run(NamedTuple):
    """An experiment, what it found, the verdicts on its numbers, and the seconds it took."""

    experiment: Experiment
    outcome: ExperimentResult
    judged: list[FindingVerdicts]
    seconds: float

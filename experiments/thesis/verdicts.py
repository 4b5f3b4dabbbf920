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
    its last digit (zeros at the end of a whole number are none); `why` says for what kind of
    number it is.
    """

    why: str
    relative: float = 0.0
    absolute: float = 0.0
    digits: float = 0.0

    def __str__(self) -> str:
        parts = [f"{self.absolute:g}"] if self.absolute else []
        parts += [f"{100 * self.relative:g} %"] if self.relative else []
        parts += [f"{self.digits:g} in the last digit"] if self.digits else []
        return " or ".join(parts)


@dataclasses.dataclass(frozen=True)
class Printed:
    """Printed numbers of one kind: what, where, and how near ours must come.

    `values` are written as printed, since their digits count; `labels` name them one by one.
    `kind` is "measured" or "computed", by the thesis; `reading` is what was chosen where it is
    ambiguous.
    """

    where: str
    what: str
    unit: str
    kind: str
    tolerance: Tolerance
    values: str
    labels: str = ""
    reading: str = ""

    @property
    def numbers(self) -> np.ndarray:
        """The values as numbers."""
        return np.array([float(word) for word in self.values.split()])

    @property
    def allowed(self) -> np.ndarray:
        """How far ours may be from each of the values."""
        last = self.tolerance.digits * np.array([_last_digit(w) for w in self.values.split()])
        wide = self.tolerance.relative * np.abs(self.numbers)
        return np.maximum(np.maximum(wide, last), self.tolerance.absolute)

    @property
    def names(self) -> list[str]:
        """A label for each value."""
        labels = self.labels.split()
        return labels or [""] * self.numbers.size


def _last_digit(word: str) -> float:
    """One unit of the last digit of a number; zeros at the end of a whole number are none."""
    if "." in word:
        return 10.0 ** -len(word.partition(".")[2])
    return 10.0 ** (len(word) - len(word.rstrip("0")))


REPRODUCED, EXPLAINED = "reproduced", "explained"
IMPOSSIBLE, NOT = "cannot be reproduced", "not reproduced"
VERDICTS = (REPRODUCED, EXPLAINED, IMPOSSIBLE, NOT)


@dataclasses.dataclass(frozen=True)
class Finding:
    """Printed numbers beside ours, by one reading of the thesis or by several.

    The first of the `readings` is what the thesis says; the others are what it may have meant,
    each named by a reason. `obstacle` is why the numbers cannot be right for the rig that is
    stated, if a computation has shown that, else empty.
    """

    printed: Printed
    readings: Mapping[str, np.ndarray]
    obstacle: str = ""

    def __post_init__(self):
        count = self.printed.numbers.size
        for name, values in self.readings.items():
            if np.shape(values) != (count,):
                raise ValueError(f"{self.printed.where}, {name}: {count} numbers are printed")

    def within(self, reading: str) -> np.ndarray:
        """Whether each number of a reading is as near as it must be."""
        # The last bit of a difference of rounded numbers does not count.
        far = np.abs(np.asarray(self.readings[reading]) - self.printed.numbers)
        return far <= self.printed.allowed * (1 + 1e-9)


def finding(
    printed: Printed, values, others: Mapping[str, np.ndarray] | None = None, obstacle: str = ""
) -> Finding:
    """A finding by the reading as printed, and by `others`, each named by what it takes instead."""
    readings = {"as printed": values} | dict(others or {})
    return Finding(
        printed, {k: np.atleast_1d(np.asarray(v)) for k, v in readings.items()}, obstacle
    )


def best_reading(findings: Sequence[Finding]) -> str:
    """Of the other readings that findings have in common, the one that meets most numbers.

    One reading has to serve for all: no number gets one of its own. Empty if there is no other.
    """
    others = list(findings[0].readings)[1:]
    hits = {name: sum(int(one.within(name).sum()) for one in findings) for name in others}
    return max(hits, key=lambda name: hits[name], default="")


class Judged(NamedTuple):
    """Verdicts on the numbers of a finding, and for each the reading of ours it rests on."""

    words: list[str]
    by: list[str]


def judge(findings: Sequence[Finding]) -> list[Judged]:
    """The verdicts on the numbers of each finding.

    Reproduced: the reading as printed is within the tolerance. Explained: another reading is, the
    same for all findings that offer the same ones. Otherwise it cannot be reproduced, if there is
    an obstacle, or is not.
    """
    judged = []
    for one in findings:
        alike = [other for other in findings if list(other.readings) == list(one.readings)]
        first, second = next(iter(one.readings)), best_reading(alike)
        explained = one.within(second) if second else np.zeros(one.printed.numbers.size, bool)
        words = [
            REPRODUCED if plain else EXPLAINED if other else IMPOSSIBLE if one.obstacle else NOT
            for plain, other in zip(one.within(first), explained, strict=True)
        ]
        judged.append(Judged(words, [second if word == EXPLAINED else first for word in words]))
    return judged


@dataclasses.dataclass(frozen=True)
class Outcome:
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
    run: Callable[[Callable[[str], jb.Case]], Outcome]


class Run(NamedTuple):
    """An experiment, what it found, the verdicts on its numbers, and the seconds it took."""

    experiment: Experiment
    outcome: Outcome
    judged: list[Judged]
    seconds: float

"""Verdicts on published numbers, computed from readings of the thesis and from null models.

The rules are strict. One reading serves for all numbers of a physical rig in a chapter: the
likeliest set of answers to what the text leaves open, by the sum of squared differences over
tolerances, plus two for each fitted parameter (Akaike). A number that a null model (no control,
static, one mode) meets within the same tolerance, or that cannot tell the reading from the null
model, counts for nothing, nor does one that a parameter of the reading was fitted to, one that
repeats another, arithmetic with printed numbers, or a yes or a no.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.published_numbers import PublishedNumbers

REPRODUCED, EXPLAINED = "reproduced", "explained"
IRREPRODUCIBLE, INCONSISTENT = "cannot be right", "cannot all be right"
NOT_REPRODUCED = "not reproduced"
NULL_MET, FITTED = "met by the null model", "fitted to it"
REPEATED, STATEMENT = "repeats another", "a yes or a no"
VERDICTS = (REPRODUCED, EXPLAINED, IRREPRODUCIBLE, INCONSISTENT, NOT_REPRODUCED)  # that count
NOT_COUNTED = (NULL_MET, FITTED, REPEATED, STATEMENT)
LITERAL = "as printed"  # name of the reading that takes the thesis at its word
# Differences in tolerances beyond which they are alike, and those that one standard deviation is.
FARTHEST, STANDARD_DEVIATION = 3.0, 0.5

Reading = frozenset[str]  # answers other than those printed; none takes the thesis at its word


class NullModel(NamedTuple):
    """A model that leaves out what the thesis studies, and its values (number,)."""

    name: str
    values: np.ndarray


@dataclasses.dataclass(frozen=True)
class Finding:
    """Published numbers beside computed ones, under one or more readings of the thesis.

    `readings` maps the answers that matter for these numbers to computed values (number,); the
    first has none and takes the thesis at its word. `fitted` maps an answer to the labels of the
    numbers that its parameters were fitted to, one label for each parameter unless `parameters` has
    their number, so that parameters of several findings count once. `impossible` maps the labels of
    numbers, or "" for all, to a computed proof that each of them cannot be right for the stated
    rig; `inconsistent` is one that not all numbers of the finding can be, which marks none of them
    singly; `remark` says why a number is not met where that is known.

    Raises ValueError if a model has another count of values than is published.
    """

    published: PublishedNumbers
    readings: Mapping[Reading, np.ndarray]
    null: NullModel
    fitted: Mapping[str, str] = dataclasses.field(default_factory=dict)
    impossible: Mapping[str, str] = dataclasses.field(default_factory=dict)
    inconsistent: str = ""
    remark: str = ""
    parameters: Mapping[str, int] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        count = self.published.numbers.size
        values = {reading_name(reading): values for reading, values in self.readings.items()}
        for name, each in (values | {self.null.name: self.null.values}).items():
            if np.shape(each) != (count,):
                raise ValueError(f"{self.published.location}, {name}: {count} numbers are printed")

    @property
    def answers(self) -> Reading:
        """All answers that change a value of this finding."""
        return frozenset().union(*self.readings)

    def values(self, reading: Reading) -> np.ndarray:
        """Computed values (number,) under a reading of the rig; other questions do not matter."""
        return self.readings[reading & self.answers]

    def within_tolerance(self, reading: Reading) -> np.ndarray:
        """Whether each computed number is within the tolerance, (number,)."""
        return self.published.agrees(self.values(reading))

    def null_within_tolerance(self, reading: Reading) -> np.ndarray:
        """Whether the null model meets each number, or agrees with the reading, (number,).

        They agree where both differ by less than the tolerance.
        """
        with np.errstate(invalid="ignore"):  # infinite limits
            apart = np.abs(self.null.values - self.values(reading))
        return self.published.agrees(self.null.values) | (apart < self.published.allowed_error)

    def misfit(self, reading: Reading | None) -> float:
        """Minus twice the logarithm of the likelihood, up to a constant; of the null if None.

        Normal with a standard deviation of half the tolerance, differences cut off at three
        tolerances, over the numbers that count, and two for each fitted parameter.
        """
        values = self.null.values if reading is None else self.values(reading)
        off = np.abs(values - self.published.numbers) / self.published.allowed_error
        off = np.minimum(np.where(np.isnan(off), FARTHEST, off), FARTHEST) / STANDARD_DEVIATION
        counted = ~(self.published.repeated | self.published.statement)
        parameters = sum(
            self.parameters.get(answer, len(self.fitted.get(answer, "").split()))
            for answer in reading or ()
        )
        return float(np.sum(off[counted] ** 2)) + 2 * parameters


def reading_name(reading: Reading) -> str:
    """The answers of a reading in words."""
    return "; ".join(sorted(reading)) or LITERAL


def make_finding(
    published: PublishedNumbers,
    values,
    alternatives: Mapping[str | tuple[str, ...], object] | None = None,
    *,
    null: tuple[str, object],
    fitted: Mapping[str, str] | None = None,
    parameters: Mapping[str, int] | None = None,
    impossible: Mapping[str, str] | None = None,
    inconsistent: str = "",
    remark: str = "",
) -> Finding:
    """A finding with `values` as printed, and `alternatives` by an answer or several.

    Values are numbers or arrays (number,), and so are those of the `null` model (name, values),
    where one number stands for all. Raises ValueError if their count is not that published.
    """
    readings = {(): values} | dict(alternatives or {})
    arrays = {
        frozenset([answers] if isinstance(answers, str) else answers): np.atleast_1d(
            np.asarray(v, float)
        )
        for answers, v in readings.items()
    }
    name, null_values = null
    null_array = np.asarray(null_values, float)
    if null_array.ndim == 0:
        null_array = np.full(published.numbers.size, null_array)
    return Finding(
        published,
        arrays,
        NullModel(name, null_array),
        fitted or {},
        {labels: proof for labels, proof in (impossible or {}).items() if proof},
        inconsistent,
        remark,
        parameters or {},
    )


def readings_of(group: Sequence[Finding]) -> list[Reading]:
    """All readings of a rig: sets of answers of which each finding has a value.

    Answers that a finding has apart, but never together, exclude one another.
    """
    readings = {frozenset(): None}
    for one in group:
        readings |= {
            reading | answers: None
            for reading in readings
            for answers in one.readings
            if reading & one.answers <= answers
        }
    return [
        reading
        for reading in readings
        if all(reading & one.answers in one.readings for one in group)
    ]


def likeliest_reading(group: Sequence[Finding]) -> Reading:
    """The reading with the least misfit over all findings of a rig."""
    return min(readings_of(group), key=lambda reading: _misfit(group, reading))


def _misfit(group: Sequence[Finding], reading: Reading | None) -> float:
    return sum(one.misfit(reading) for one in group)


class FindingVerdicts(NamedTuple):
    """Verdict on each number of a finding, and the reading of the rig that all of them rest on.

    `misfits` are those of the rig by the answers that matter for the finding, the others being the
    likeliest; that of the null models under None.
    """

    verdicts: list[str]
    reading: Reading
    misfits: dict[Reading | None, float]


def assign_verdicts(findings: Sequence[Finding]) -> list[FindingVerdicts]:
    """Verdicts on the numbers of each finding, by the likeliest reading of its rig.

    Numbers that repeat others, and statements, count for nothing. One that is within tolerance is
    "met by the null model" if that meets it too or is as near, "fitted to it" if a parameter was;
    else "reproduced", if the thesis taken at its word gives the same, or "explained". One that is
    not is "cannot be right" if there is a proof for it, "cannot all be right" if there is one for
    the numbers of the finding together, else "not reproduced". No reading that is less likely than
    the null model explains anything.
    """
    groups: dict[str, list[Finding]] = {}
    for one in findings:
        groups.setdefault(one.published.rig, []).append(one)
    judged = {}
    for rig, group in groups.items():
        misfits = {reading: _misfit(group, reading) for reading in readings_of(group)}
        best = min(misfits, key=misfits.__getitem__)
        judged[rig] = best, misfits, _misfit(group, None)
    return [_verdicts(one, *judged[one.published.rig]) for one in findings]


def _verdicts(
    one: Finding, best: Reading, by_rig: Mapping[Reading, float], by_null: float
) -> FindingVerdicts:
    own: dict[Reading | None, float] = {}
    for reading, misfit in by_rig.items():
        answers = reading & one.answers
        own[answers] = min(misfit, own.get(answers, np.inf))
    met, null_met = one.within_tolerance(best), one.null_within_tolerance(best)
    as_printed = np.isclose(one.values(best), one.values(frozenset()), rtol=1e-9, atol=0)
    used = np.zeros(met.size, bool)
    for answer in best & one.fitted.keys():
        used |= one.published.has_label(one.fitted[answer])
    refuted = np.zeros(met.size, bool)
    for labels in one.impossible:
        refuted |= one.published.has_label(labels) if labels else True
    likely = by_rig[best] < by_null
    verdicts = [
        STATEMENT
        if one.published.statement
        else REPEATED
        if one.published.repeated[i]
        else (
            IRREPRODUCIBLE if refuted[i] else INCONSISTENT if one.inconsistent else NOT_REPRODUCED
        )
        if not (met[i] and likely)
        else NULL_MET
        if null_met[i]
        else FITTED
        if used[i]
        else REPRODUCED
        if as_printed[i]
        else EXPLAINED
        for i in range(met.size)
    ]
    return FindingVerdicts(verdicts, best, own | {None: by_null})


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

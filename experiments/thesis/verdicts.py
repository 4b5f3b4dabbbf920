"""Published numbers, and verdicts on them from readings of the thesis and from null models.

The rules are strict. One reading serves for all numbers of a physical rig in a chapter: the
likeliest set of answers to what the text leaves open, by the sum of squared differences over
tolerances, plus two for each fitted parameter (Akaike). A number that a null model (no control,
static, one mode) meets within the same tolerance, or that cannot tell the reading from the null
model, counts for nothing, nor does one that a parameter of the reading was fitted to, one that
repeats another, arithmetic with printed numbers, or a yes or a no.

Numbers that are printed in the thesis, with the tolerance of each.

Tolerances by the kind of published number, and the unit of frequency.

Computed numbers: a unit of the last printed digit, and the rounding of the printed parameters where
the number follows from them. Measured numbers: twice the standard deviation of the sensors, which
section 5.1 prints beside no peak; the scatter of a table is no independent measure of its errors.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb

SHORT_WHOLE_NUMBER = 3  # digits up to which zeros at the end of a whole number are digits


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Allowed difference from a published number: the largest of three bounds.

    `relative` is a fraction of the number, `absolute` in its unit, for all numbers or for each,
    `digits` counts units of its last printed digit (zeros at the end of a whole number of four or
    more digits are not digits). `basis` names what the tolerance rests on.
    """

    basis: str
    relative: float = 0.0
    absolute: float | tuple[float, ...] = 0.0
    digits: float = 0.0


DIGITS = Tolerance("computed: a unit of the last printed digit", digits=1)
# 11.68 N m^2 and 0.535 kg/m are rounded by 0.04 and 0.09 %, frequencies by half of the sum.
FORMULA = Tolerance(
    "follows from 11.68 N m^2 and 0.535 kg/m as far as their digits go", digits=1, relative=0.0007
)
SAMPLE_INSTANT = Tolerance("an instant of a sampled run, to one sample", absolute=0.01)
# Variances of the sensors by section 5.1: 0.0365, 0.135, 0.0729 times 1e-10 m^2; the noisiest.
NOISE = 2e3 * np.sqrt(0.135e-10)  # mm, two standard deviations
MEASURED = Tolerance("measured: twice the noise of a sensor (5.1)", absolute=float(NOISE))
SAME_CURVE = Tolerance("called identical: the width of a line in a figure", absolute=1.0)
YES_OR_NO = Tolerance("yes (1) or no (0)", absolute=0.5)

HZ = "Hz"


@dataclasses.dataclass(frozen=True)
class PublishedNumbers:
    """Published numbers of one quantity: location, unit, digits, origin, and tolerance.

    `printed_text` holds the numbers as printed, separated by spaces, and `labels` a name for each.
    `rig` is the physical rig that they are of, and the chapter: one reading serves for all of it.
    `origin` is "measured" or "computed", as the thesis says. `interpretation` says how an ambiguous
    statement is read. `repeats` says where else the numbers are printed, or from which printed
    numbers they follow by arithmetic: such numbers are shown and not counted. `repeated_labels` has
    the labels of those that repeat; all do if it is empty.
    """

    location: str
    quantity: str
    unit: str
    printed_text: str
    labels: str = ""
    origin: str = "computed"
    tolerance: Tolerance = DIGITS
    interpretation: str = ""
    repeats: str = ""
    repeated_labels: str = ""
    rig: str = ""

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
        return np.maximum(np.maximum(by_share, by_digits), np.asarray(self.tolerance.absolute))

    @property
    def value_labels(self) -> list[str]:
        """One label for each value, empty where none is given."""
        labels = self.labels.split()
        return labels or [""] * self.numbers.size

    @property
    def repeated(self) -> np.ndarray:
        """Whether each number repeats another, (number,)."""
        if not self.repeats:
            return np.zeros(self.numbers.size, bool)
        return self.has_label(self.repeated_labels or self.labels)

    @property
    def statement(self) -> bool:
        """Whether the numbers stand for a yes or a no, which counts for nothing."""
        return self.tolerance.basis in (YES_OR_NO.basis, SAME_CURVE.basis)

    def has_label(self, labels: str) -> np.ndarray:
        """Whether the label of each number is among `labels`, (number,)."""
        return np.isin(self.value_labels, labels.split() or [""])

    def agrees(self, values) -> np.ndarray:
        """Whether each of `values` (number,) is within the tolerance."""
        # Differences of decimal numbers are off by rounding: 1.1 - 1.0 exceeds 0.1.
        return np.abs(np.asarray(values) - self.numbers) <= self.allowed_error * (1 + 1e-9)


def measured_peaks(
    location: str, quantity: str, printed_text: str, labels: str, **others
) -> PublishedNumbers:
    """Measured peaks (mm), to within the noise of a sensor; `others` are further fields."""
    return PublishedNumbers(
        location, quantity, "mm", printed_text, labels, "measured", MEASURED, **others
    )


def measured_shares(
    location: str,
    quantity: str,
    printed_text: str,
    peaks: Sequence[float],
    labels: str = "",
    runs: int = 1,
    **others,
) -> PublishedNumbers:
    """Ratios (%) of two measured peaks, the means over `runs` runs; `others` are further fields.

    The tolerance is in points, for each of `peaks` (mm) without control.
    """
    points = tuple(float(100 * NOISE * np.sqrt(2 / runs) / peak) for peak in peaks)
    tolerance = Tolerance("measured: twice the noise of a sensor (5.1), in both peaks", 0, points)
    return PublishedNumbers(
        location, quantity, "%", printed_text, labels, "measured", tolerance, **others
    )


def _last_digit_unit(word: str) -> float:
    """One unit of the last printed digit; zeros at the end of long whole numbers are not digits."""
    digits, _, exponent = word.lower().partition("e")
    scale = 10.0 ** int(exponent or 0)
    if "." in digits:
        return scale * 10.0 ** -len(digits.partition(".")[2])
    if len(digits.lstrip("+-")) <= SHORT_WHOLE_NUMBER:
        return scale
    return scale * 10.0 ** (len(digits) - len(digits.rstrip("0")))


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
    `jaxbeam.case.library.rigs.load` does.
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

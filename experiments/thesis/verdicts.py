"""Verdicts on published numbers, computed from readings of the thesis and from null models.

The rules are strict. One reading serves for all numbers of a group: the likeliest, by the sum of
squared differences over tolerances, plus two for each fitted parameter (Akaike). A number that a
null model (no control, static, one mode) meets within the same tolerance counts for nothing, nor
does one that a parameter of the reading was fitted to, nor one that repeats another.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.published_numbers import PublishedNumbers

REPRODUCED, EXPLAINED = "reproduced", "explained"
IRREPRODUCIBLE, NOT_REPRODUCED = "cannot be right", "not reproduced"
NULL_MET, FITTED, REPEATED = "met by the null model", "fitted to it", "repeats another"
VERDICTS = (REPRODUCED, EXPLAINED, IRREPRODUCIBLE, NOT_REPRODUCED)  # those that count
NOT_COUNTED = (NULL_MET, FITTED, REPEATED)
LITERAL = "as printed"  # name of the interpretation that takes the thesis at its word
# Differences in tolerances beyond which they are alike, and those that one standard deviation is.
FARTHEST, STANDARD_DEVIATION = 3.0, 0.5


class NullModel(NamedTuple):
    """A model that leaves out what the thesis studies, and its values (number,)."""

    name: str
    values: np.ndarray


@dataclasses.dataclass(frozen=True)
class Finding:
    """Published numbers beside computed ones, under one or more interpretations of the thesis.

    `interpretations` maps a name to computed values (number,); the first takes the thesis at its
    word, the others are what it may have meant. `fitted` maps an interpretation to the labels of
    the numbers that its parameters were fitted to, one label for each parameter unless `parameters`
    has their number, so that parameters of several findings count once. `impossible` is a
    computed proof that no value can be right for the stated rig, or empty, `remark` says why a
    number is not met where that is known.

    Raises ValueError if a model has another count of values than is published.
    """

    published: PublishedNumbers
    interpretations: Mapping[str, np.ndarray]
    null: NullModel
    fitted: Mapping[str, str] = dataclasses.field(default_factory=dict)
    impossible: str = ""
    remark: str = ""
    parameters: Mapping[str, int] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        count = self.published.numbers.size
        for name, values in (self.interpretations | {self.null.name: self.null.values}).items():
            if np.shape(values) != (count,):
                raise ValueError(f"{self.published.location}, {name}: {count} numbers are printed")

    def within_tolerance(self, interpretation: str) -> np.ndarray:
        """Whether each computed number is within the tolerance, (number,)."""
        return self.published.agrees(self.interpretations[interpretation])

    @property
    def null_within_tolerance(self) -> np.ndarray:
        """Whether the null model meets each number within its tolerance, (number,)."""
        return self.published.agrees(self.null.values)

    def misfit(self, interpretation: str | None) -> float:
        """Minus twice the logarithm of the likelihood, up to a constant; of the null if None.

        Normal with a standard deviation of half the tolerance, differences cut off at three
        tolerances, over the numbers that repeat no others, and two for each fitted parameter.
        """
        by_null = interpretation is None
        values = self.null.values if by_null else self.interpretations[interpretation]
        off = np.abs(np.asarray(values) - self.published.numbers) / self.published.allowed_error
        off = np.minimum(np.where(np.isnan(off), FARTHEST, off), FARTHEST) / STANDARD_DEVIATION
        labels = "" if by_null else self.fitted.get(interpretation, "")
        by_labels = len(labels.split())
        parameters = 0 if by_null else self.parameters.get(interpretation, by_labels)
        return float(np.sum(off[~self.published.repeated] ** 2)) + 2 * parameters


def make_finding(
    published: PublishedNumbers,
    values,
    alternatives: Mapping[str, np.ndarray] | None = None,
    *,
    null: tuple[str, object],
    fitted: Mapping[str, str] | None = None,
    parameters: Mapping[str, int] | None = None,
    impossible: str = "",
    remark: str = "",
) -> Finding:
    """A finding with `values` by the literal interpretation, and `alternatives` by name.

    Values are numbers or arrays (number,), and so are those of the `null` model (name, values),
    where one number stands for all. Raises ValueError if their count is not that published.
    """
    interpretations = {LITERAL: values} | dict(alternatives or {})
    arrays = {name: np.atleast_1d(np.asarray(v, float)) for name, v in interpretations.items()}
    name, null_values = null
    null_array = np.asarray(null_values, float)
    if null_array.ndim == 0:
        null_array = np.full(published.numbers.size, null_array)
    return Finding(
        published,
        arrays,
        NullModel(name, null_array),
        fitted or {},
        impossible,
        remark,
        parameters or {},
    )


def group_of(finding: Finding, findings: Sequence[Finding]) -> list[Finding]:
    """The findings that have the same interpretations: one of them must serve for all."""
    names = list(finding.interpretations)
    return [one for one in findings if list(one.interpretations) == names]


def likeliest_interpretation(group: Sequence[Finding]) -> str:
    """Name of the interpretation with the least misfit over all findings of a group."""
    names = list(group[0].interpretations)
    return min(names, key=lambda name: sum(one.misfit(name) for one in group))


class FindingVerdicts(NamedTuple):
    """Verdict on each number of a finding, and the interpretation that all of them rest on.

    `misfits` are those of the group by interpretation, that of the null models under None.
    """

    verdicts: list[str]
    interpretation: str
    misfits: dict[str | None, float]


def assign_verdicts(findings: Sequence[Finding]) -> list[FindingVerdicts]:
    """Verdicts on the numbers of each finding, by the likeliest interpretation of its group.

    Numbers that repeat others count for nothing. One that is within tolerance is "met by the null
    model" if that meets it too, "fitted to it" if a parameter was; else "reproduced", if the thesis
    taken at its word gives the same, or "explained". One that is not is "cannot be right" if there
    is a proof, else "not reproduced". No interpretation that is less likely than the null model
    explains anything.
    """
    assigned = []
    for one in findings:
        group = group_of(one, findings)
        name = likeliest_interpretation(group)
        misfits = {
            key: sum(each.misfit(key) for each in group) for key in (*one.interpretations, None)
        }
        met, null_met = one.within_tolerance(name), one.null_within_tolerance
        as_printed = np.isclose(
            one.interpretations[name], one.interpretations[LITERAL], rtol=1e-9, atol=0
        )
        used = one.published.has_label(one.fitted[name]) if name in one.fitted else 0 * met
        likely = misfits[name] < misfits[None]
        verdicts = [
            REPEATED
            if one.published.repeated[i]
            else (IRREPRODUCIBLE if one.impossible else NOT_REPRODUCED)
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
        assigned.append(FindingVerdicts(verdicts, name, misfits))
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

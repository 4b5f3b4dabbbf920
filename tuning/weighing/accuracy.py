"""Accuracy classes of weighing in motion, as COST 323 defines them (Jacob, O'Brien, Jehaes 2002).

A criterion (gross weight, group of axles, single axle, axle of a group) has a class if the relative
errors of n vehicles, with the mean m and the standard deviation s, lie within its tolerance d with
the probability

    F((d - m) / s - t) + F((d + m) / s - t) - 1 >= 2 N(u - t) - 1,  t = t_{0.975, n - 1} / sqrt(n),

F being Student's distribution of n - 1 degrees of freedom, N the normal one. u is the less, the
more vehicles and seasons a test has. Tolerances, u and a worked sheet are also in the notebook on
COST 323 of OpenWIM/pywim.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxbeam.case.loads.axles import Axles
from jaxbeam.runtime.printer import TableViews, text_table
from tuning.weighing.axle_fit import axle_groups

CLASSES = "A(5)", "B+(7)", "B(10)", "C(15)", "D+(20)", "D(25)"  # and E, which are worse
TOLERANCES = {  # of these classes, relative
    "gross weight": (0.05, 0.07, 0.10, 0.15, 0.20, 0.25),
    "group of axles": (0.07, 0.10, 0.13, 0.18, 0.23, 0.28),
    "single axle": (0.08, 0.11, 0.15, 0.20, 0.25, 0.30),
    "axle of a group": (0.10, 0.14, 0.20, 0.25, 0.30, 0.35),
}
# One vehicle (r1), one at several loads and speeds (r2), some vehicles (R1), all of the traffic
# (R2); by season, of a day (I), of some days (II), of a year (III).
PLANS = {"r1": 2.675, "r2": 2.36, "R1": 2.155, "R2": 2.0}
ENVIRONMENTS = {"I": 1.0, "II": 1.05, "III": 1.1}
INITIAL = 0.8  # fraction of the tolerances, for vehicles by which the lines were calibrated
LEAST_COUNT = 5  # of errors in a criterion that is classed


class Criterion(NamedTuple):
    """Relative errors of a criterion: how many, mean, standard deviation; required probability.

    `class_name` is the best class, of the tolerance `tolerance`, within which they lie with
    `probability`; E beyond the last.
    """

    name: str
    count: int
    mean: float
    deviation: float
    required: float
    class_name: str
    tolerance: float
    probability: float


@dataclasses.dataclass(frozen=True)
class Accuracy(TableViews):
    """Accuracy classes of weighed vehicles, by criterion; `class_name` is the worst of them.

    >>> import numpy as np
    >>> import tuning
    >>> errors = {"gross weight": 0.03 * np.random.default_rng(0).normal(size=30)}
    >>> print(tuning.weighing.accuracy_class(errors).class_name)
    B+(7)
    """

    criteria: tuple[Criterion, ...]
    plan: str
    environment: str

    @property
    def class_name(self) -> str:
        """Class of the weighing, the worst of its criteria."""
        return max((one.class_name for one in self.criteria), key=[*CLASSES, "E"].index)

    @property
    def verdict(self) -> str:
        """Sentence with the class and the conditions of the test."""
        return (
            f"accuracy class {self.class_name} of COST 323 (test plan {self.plan}, environment"
            f" {self.environment})"
        )

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Columns by head: criteria, numbers, means and deviations of errors, classes."""
        heads = (
            "criterion", "number", "mean (%)", "standard deviation (%)", "required (%)", "class",
            "tolerance (%)", "within it (%)",
        )  # fmt: skip
        rows = [
            (c.name, c.count, 100 * c.mean, 100 * c.deviation, 100 * c.required, c.class_name,
             100 * c.tolerance, 100 * c.probability)
            for c in self.criteria
        ]  # fmt: skip
        return {
            head: np.array(column)
            for head, column in zip(heads, zip(*rows, strict=True), strict=True)
        }

    def to_dict(self) -> dict:
        """Classes and what they follow from, for JSON; errors as shares."""
        named = {one.name: dict(list(one._asdict().items())[1:]) for one in self.criteria}
        return {
            "class": self.class_name, "plan": self.plan, "environment": self.environment,
            "criteria": named,
        }  # fmt: skip

    def __str__(self) -> str:
        rows = [
            [one if isinstance(one, str) else f"{one:.4g}" for one in row]
            for row in zip(*self.columns.values(), strict=True)
        ]
        return "\n".join([self.verdict, *text_table(list(self.columns), rows, "<>>>><>>")])


def relative_errors(pairs: Iterable[tuple[Axles, Axles]]) -> dict[str, Float[np.ndarray, " error"]]:
    """Relative errors by criterion, from pairs of a weighed vehicle and its reference.

    Groups are axles of the reference less than 2.2 m apart. A vehicle that was weighed with another
    number of axles has an error of the gross weight only.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> about = dict(offsets=[0.0, 4.0], speed=20.0)
    >>> weighed, known = (jb.Axles(forces=pair, **about) for pair in ([66e3, 99e3], [60e3, 100e3]))
    >>> for name, errors in tuning.weighing.relative_errors([(weighed, known)]).items():
    ...     print(name, errors.round(4))
    gross weight [0.0312]
    group of axles []
    single axle [ 0.1  -0.01]
    axle of a group []
    """
    found: dict[str, list[float]] = {name: [] for name in TOLERANCES}
    for weighed, known in pairs:
        forces, truth = np.asarray(weighed.forces), np.asarray(known.forces)
        found["gross weight"].append(forces.sum() / truth.sum() - 1)
        if forces.size != truth.size:
            continue
        for group in axle_groups(np.asarray(known.offsets)):
            single = len(group) == 1
            own = "single axle" if single else "axle of a group"
            found[own] += (forces[group] / truth[group] - 1).tolist()
            if not single:
                found["group of axles"].append(forces[group].sum() / truth[group].sum() - 1)
    return {name: np.array(errors) for name, errors in found.items()}


def accuracy_class(
    errors: Mapping[str, Float[np.ndarray, " error"]],
    plan: str = "R1",
    environment: str = "I",
    *,
    initial: bool = False,
) -> Accuracy:
    """Accuracy class of relative errors by criterion, as `relative_errors` returns them.

    The test `plan` is r1, r2, R1 or R2, the `environment` I, II or III. An `initial` verification
    is by the vehicles of the calibration, with 0.8 times the tolerances. Criteria of fewer than
    five errors are left out.

    Raises ValueError for another plan or environment, another criterion, and if none has five
    errors.

    >>> import numpy as np
    >>> import tuning
    >>> errors = {"gross weight": np.array([0.01, -0.02, 0.0, 0.01, 0.02, -0.01])}
    >>> print(tuning.weighing.accuracy_class(errors).verdict)
    accuracy class A(5) of COST 323 (test plan R1, environment I)
    """
    for given, known in (
        (plan, PLANS),
        (environment, ENVIRONMENTS),
        *((n, TOLERANCES) for n in errors),
    ):
        if given not in known:
            raise ValueError(f"accuracy classes know {', '.join(known)}, not {given!r}")
    share = INITIAL if initial else 1.0
    criteria = [
        _criterion(name, np.asarray(own), PLANS[plan] / ENVIRONMENTS[environment], share)
        for name, own in errors.items()
        if len(own) >= LEAST_COUNT
    ]
    if not criteria:
        raise ValueError(f"an accuracy class needs {LEAST_COUNT} weighed vehicles or more")
    return Accuracy(tuple(criteria), plan, environment)


def _criterion(name: str, errors: Float[np.ndarray, " error"], u: float, share: float) -> Criterion:
    """Class of the errors of a criterion."""
    count, mean, deviation = errors.size, float(errors.mean()), float(errors.std(ddof=1))
    student = scipy.stats.t(count - 1)
    uncertain = float(student.ppf(0.975)) / np.sqrt(count)
    required = 2 * float(scipy.stats.norm.cdf(u - uncertain)) - 1
    size = max(deviation, 1e-12)
    for class_name, tolerance in zip(CLASSES, TOLERANCES[name], strict=True):
        own = share * tolerance
        sides = [student.cdf((own + sign * mean) / size - uncertain) for sign in (-1, 1)]
        probability = float(sum(sides)) - 1
        if probability >= required:
            return Criterion(name, count, mean, deviation, required, class_name, own, probability)
    return Criterion(name, count, mean, deviation, required, "E", own, probability)

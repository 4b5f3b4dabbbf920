"""Comparison of two files of results, array by array."""

import dataclasses
from pathlib import Path

import numpy as np

TOLERANCE = 1e-12  # of the largest number of an array


@dataclasses.dataclass
class CaseDifference:
    """Arrays of a case: count, count of equal ones, largest relative difference, and where."""

    arrays: int = 0
    equal: int = 0
    difference: float = 0.0
    where: str = ""

    def add(self, name: str, difference: float) -> None:
        """Count one more array."""
        self.arrays += 1
        self.equal += difference == 0
        if difference > self.difference:
            self.difference, self.where = difference, name


def relative_difference(first: np.ndarray, second: np.ndarray) -> float:
    """Largest difference of two arrays over the largest number of the first.

    Infinite where shapes differ, or where NaN and infinities are not the same.
    """
    if first.shape != second.shape:
        return np.inf
    first, second = np.asarray(first, float), np.asarray(second, float)
    finite = np.isfinite(first)
    if not np.array_equal(first[~finite], second[~finite], equal_nan=True):
        return np.inf
    if not np.all(np.isfinite(second[finite])):
        return np.inf
    difference = np.max(np.abs(first[finite] - second[finite]), initial=0.0)
    size = np.max(np.abs(first[finite]), initial=0.0)
    if difference == 0:
        return 0.0
    return float(difference / size) if size > 0 else np.inf


def case_differences(first: Path, second: Path) -> dict[str, CaseDifference]:
    """Largest differences of two files by case; infinite where an array is in one file only."""
    cases: dict[str, CaseDifference] = {}
    with np.load(first) as a, np.load(second) as b:
        for name in sorted(set(a.files) | set(b.files)):
            title, array = name.split("/", 1)
            case = cases.setdefault(title, CaseDifference())
            if name in a.files and name in b.files:
                case.add(array, relative_difference(a[name], b[name]))
            else:
                case.add(f"{array} (only in {first if name in a.files else second})", np.inf)
    return cases


def compare(first: Path, second: Path, tolerance: float = TOLERANCE) -> bool:
    """Print the largest difference of each case; return whether all are within the tolerance."""
    cases = case_differences(first, second)
    print(f"{'case':34} {'arrays':>6} {'equal':>6} {'difference':>11}  largest in")
    for title, case in cases.items():
        mark = "" if case.difference <= tolerance else "  <- above the tolerance"
        counts = f"{case.arrays:6} {case.equal:6}"
        print(f"{title:34} {counts} {case.difference:11.1e}  {case.where}{mark}")
    worst = max((case.difference for case in cases.values()), default=np.inf)
    same = worst <= tolerance
    print(
        f"largest difference {worst:.1e}: {'the same' if same else 'NOT the same'} to {tolerance:g}"
    )
    return bool(same)

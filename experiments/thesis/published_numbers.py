"""Numbers that are printed in the thesis, with the tolerance of each.

Tolerances by the kind of published number, and the unit of frequency.

Computed numbers: a unit of the last printed digit, and the rounding of the printed parameters where
the number follows from them. Measured numbers: twice the standard deviation of the sensors, which
section 5.1 prints beside no peak; the scatter of a table is no independent measure of its errors.
"""

import dataclasses

import numpy as np

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


@dataclasses.dataclass(frozen=True)
class PublishedNumbers:
    """Published numbers of one quantity: location, unit, origin, tolerance, and the digits.

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
    origin: str
    tolerance: Tolerance
    printed_text: str
    labels: str = ""
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


def _last_digit_unit(word: str) -> float:
    """One unit of the last printed digit; zeros at the end of long whole numbers are not digits."""
    digits, _, exponent = word.lower().partition("e")
    scale = 10.0 ** int(exponent or 0)
    if "." in digits:
        return scale * 10.0 ** -len(digits.partition(".")[2])
    if len(digits.lstrip("+-")) <= SHORT_WHOLE_NUMBER:
        return scale
    return scale * 10.0 ** (len(digits) - len(digits.rstrip("0")))


DIGITS = Tolerance("computed: a unit of the last printed digit", digits=1)
# 11.68 N m^2 and 0.535 kg/m are rounded by 0.04 and 0.09 %, frequencies by half of the sum.
FORMULA = Tolerance(
    "follows from 11.68 N m^2 and 0.535 kg/m as far as their digits go", digits=1, relative=0.0007
)
SAMPLE_INSTANT = Tolerance("an instant of a sampled run, to one sample", absolute=0.01)
# Variances of the sensors by section 5.1: 0.0365, 0.135, 0.0729 times 1e-10 m^2; the noisiest.
NOISE = 2e3 * np.sqrt(0.135e-10)  # mm, two standard deviations
MEASURED = Tolerance("measured: twice the noise of a sensor (5.1)", absolute=float(NOISE))


def of_two_peaks(*peaks: float, runs: int = 1) -> Tolerance:
    """Tolerance (points) of a ratio of two measured peaks, for each uncontrolled peak (mm).

    Peaks are means over `runs` runs.
    """
    points = (float(100 * NOISE * np.sqrt(2 / runs) / peak) for peak in peaks)
    return Tolerance("measured: twice the noise of a sensor (5.1), in both peaks", 0, tuple(points))


SAME_CURVE = Tolerance("called identical: the width of a line in a figure", absolute=1.0)
YES_OR_NO = Tolerance("yes (1) or no (0)", absolute=0.5)

HZ = "Hz"

"""Modes identified from samples, their shapes, and the reasons for which some are rejected."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxbeam.runtime.printer import TableViews, counted, text_table
from tuning.logs.log import Log


def mac_matrix(
    first: Complex[np.ndarray, "mode channel"], second: Complex[np.ndarray, "other channel"]
) -> Float[np.ndarray, "mode other"]:
    """Modal assurance criterion |a^H b|^2 / (a^H a b^H b) of two sets of shapes (Allemang 2003).

    Components that are NaN were not measured: two shapes are compared where both were, and are not
    alike (0) if they nowhere were.
    """
    in_first, in_second = np.isfinite(first), np.isfinite(second)
    first, second = np.where(in_first, first, 0), np.where(in_second, second, 0)
    products = np.abs(first.conj() @ second.T) ** 2
    norms = (np.abs(first) ** 2 @ in_second.T) * (in_first @ np.abs(second.T) ** 2)
    return products / np.maximum(norms, 1e-300)


def phase_collinearity(shapes: Complex[np.ndarray, "mode channel"]) -> Float[np.ndarray, " mode"]:
    """Modal phase collinearity: 1 for components on a line of the complex plane, 0 on a circle.

    The squared ratio of difference and sum of the eigenvalues of the scatter matrix of real and
    imaginary parts (Pappa, Elliott and Schenk 1993, without their subtraction of the mean).
    """
    xx = np.sum(shapes.real**2, axis=1)
    yy = np.sum(shapes.imag**2, axis=1)
    xy = np.sum(shapes.real * shapes.imag, axis=1)
    return ((xx - yy) ** 2 + 4 * xy**2) / np.maximum((xx + yy) ** 2, 1e-300)


def normalised(shapes: Complex[np.ndarray, "mode channel"]) -> Complex[np.ndarray, "mode channel"]:
    """Shapes rotated to be as real as possible, with the largest component equal to one."""
    xx_yy = np.sum(shapes.real**2 - shapes.imag**2, axis=1)
    xy = np.sum(shapes.real * shapes.imag, axis=1)
    turned = shapes * np.exp(-0.5j * np.arctan2(2 * xy, xx_yy))[:, None]
    largest = np.take_along_axis(
        turned, np.argmax(np.abs(turned.real), axis=1)[:, None], axis=1
    ).real
    return turned / np.where(largest == 0, 1.0, largest)


MAX_RELATIVE_FREQUENCY_SD = 0.02  # of a mode; a frequency less certain names none
# Half that of welded steel chimneys, the least of EN 1991-1-4, table F.2 (a decrement of 0.012).
MIN_STRUCTURAL_DAMPING = 1e-3
MAX_DAMPING_RATIO = 0.2  # of a mode of a structure
SAME_MAC = 0.9  # of shapes that may be one (Allemang 2003 has the criterion)
MIN_CYCLES = 4.0  # cycles of a mode in the window
MIN_ENERGY = 0.002  # of the energy of the log in the mode's part of the band
MIN_COLLINEARITY = 0.5  # modal phase collinearity, of three channels or more
MAX_IN_BAND = 0.98  # of the upper end of the band; a mode above may be the flank of another


class IdentifiedMode(NamedTuple):
    """A mode: undamped natural frequency (Hz) and damping ratio, with standard deviations.

    `energy_share` is its fraction of the energy of a channel in its part of the band, three octaves
    at most, on average over channels: how strong another part is does not matter. Close modes
    cancel in part, so that estimates may be less than 0 or more than 1; results have the nearer
    end. `shape` has a largest component of one; `shape_covariance` is that of its real parts, then
    its imaginary parts.
    """

    frequency: float
    frequency_sd: float
    damping_ratio: float
    damping_sd: float
    energy_share: float
    shape: Complex[np.ndarray, " channel"]
    shape_covariance: Float[np.ndarray, "part part"]
    quantile: float = 1.96

    @property
    def pole(self) -> complex:
        """Pole -z w + i w sqrt(1 - z^2) in 1/s, w the undamped angular frequency."""
        root = -self.damping_ratio + 1j * np.sqrt(max(1 - self.damping_ratio**2, 0.0))
        return complex(2 * np.pi * self.frequency * root)

    @property
    def collinearity(self) -> float:
        """Modal phase collinearity of the shape: 1 if all channels move in phase or antiphase."""
        measured = self.shape[np.isfinite(self.shape)]
        return float(phase_collinearity(measured[None])[0])

    def to_dict(self) -> dict:
        """Plain numbers for JSON: frequency, damping ratio, deviations, 95 % intervals, shape."""
        half = self.quantile * self.frequency_sd, self.quantile * self.damping_sd
        return {
            "frequency_hz": self.frequency,
            "frequency_sd_hz": self.frequency_sd,
            "frequency_95_hz": [self.frequency - half[0], self.frequency + half[0]],
            "damping_ratio": self.damping_ratio,
            "damping_sd": self.damping_sd,
            "damping_95": [self.damping_ratio - half[1], self.damping_ratio + half[1]],
            "energy_share": self.energy_share,
            "shape_real": _numbers(self.shape.real),
            "shape_imag": _numbers(self.shape.imag),
            "phase_collinearity": self.collinearity,
        }


def _numbers(values) -> list[float | None]:
    """Numbers for JSON, None for those that are not finite."""
    return [value if np.isfinite(value) else None for value in values.tolist()]


class Channels(NamedTuple):
    """Channels of shapes: names, measured quantities, positions (m), indices of sensors."""

    names: tuple[str, ...]
    quantities: tuple[str, ...]
    positions: tuple[float | None, ...]
    sensors: tuple[int | None, ...]


def channels_of(log: Log) -> Channels:
    """Channels of a log."""
    return Channels(log.names, log.quantities, log.positions, log.sensors)


class ModalEstimates(TableViews):
    """Frequencies, damping ratios and shapes of modes, ascending, at the channels of a source."""

    modes: tuple[IdentifiedMode, ...]
    channels: Channels
    source: str

    @property
    def headline(self) -> str:
        """Title of the modes, with the name of their source."""
        return f"{counted(len(self.modes), 'mode')} of {self.source}"

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Frequency (Hz) and damping ratio with 95 % errors, share of energy of modes, by head."""
        return {
            "frequency (Hz)": self.frequencies,
            "frequency +- 95 % (Hz)": np.diff(self.frequency_intervals).ravel() / 2,
            "damping ratio": self.damping_ratios,
            "damping ratio +- 95 %": np.diff(self.damping_intervals).ravel() / 2,
            "energy share": np.array([mode.energy_share for mode in self.modes]),
        }

    def _mode_lines(self, head: str = "", last: Sequence[str] = ()) -> list[str]:
        """Lines of a table of the modes, with a last column if it has a head."""
        if not self.modes:
            return ["  no mode is well identified"]
        header = ["frequency (Hz)", "+- 95 %", "damping ratio", "+- 95 %", "energy"]
        formats = "{:.4f}", "{:.4f}", "{:.5f}", "{:.5f}", "{:.1%}"
        rows = [
            [form.format(entry) for form, entry in zip(formats, row, strict=True)]
            for row in zip(*self.columns.values(), strict=True)
        ]
        if head:
            header, rows = [*header, head], [[*r, one] for r, one in zip(rows, last, strict=True)]
        return text_table(header, rows, ">" * 5 + "<" * bool(head), "  ")

    @property
    def frequencies(self) -> Float[np.ndarray, " mode"]:
        """Natural frequencies in Hz."""
        return np.array([mode.frequency for mode in self.modes])

    @property
    def damping_ratios(self) -> Float[np.ndarray, " mode"]:
        """Damping ratios."""
        return np.array([mode.damping_ratio for mode in self.modes])

    @property
    def frequency_intervals(self) -> Float[np.ndarray, "mode 2"]:
        """95 % intervals of the natural frequencies in Hz."""
        half = np.array([mode.quantile * mode.frequency_sd for mode in self.modes])
        return self.frequencies[:, None] + np.multiply.outer(half, [-1.0, 1.0])

    @property
    def damping_intervals(self) -> Float[np.ndarray, "mode 2"]:
        """95 % intervals of the damping ratios."""
        half = np.array([mode.quantile * mode.damping_sd for mode in self.modes])
        return self.damping_ratios[:, None] + np.multiply.outer(half, [-1.0, 1.0])

    @property
    def shapes(self) -> Complex[np.ndarray, "mode channel"]:
        """Mode shapes, each with a largest component of one; NaN where one was not measured."""
        return np.array([mode.shape for mode in self.modes], complex).reshape(
            len(self.modes), len(self.channels.names)
        )

    @property
    def mac(self) -> Float[np.ndarray, "mode mode"]:
        """Modal assurance criterion of the shapes with each other."""
        return mac_matrix(self.shapes, self.shapes)


def frequency_and_damping(
    pole: complex, covariance: Float[np.ndarray, "2 2"]
) -> tuple[float, float, float, float]:
    """Frequency |p| / 2 pi (Hz) and damping ratio of a pole p = -s + i w (1/s), with deviations.

    `covariance` is that of (s, w). Returned are frequency, its standard deviation, damping ratio,
    its standard deviation.
    """
    rate, angular_frequency, size = -pole.real, pole.imag, abs(pole)
    by_frequency = np.array([rate, angular_frequency]) / size / (2 * np.pi)
    by_damping = np.array([angular_frequency**2, -rate * angular_frequency]) / size**3
    return (
        float(size / (2 * np.pi)),
        float(np.sqrt(by_frequency @ covariance @ by_frequency)),
        float(rate / size),
        float(np.sqrt(by_damping @ covariance @ by_damping)),
    )


def is_at_edge(mode: IdentifiedMode, band: tuple[float, float]) -> bool:
    """Whether a mode, with its half-power bandwidth, is not well within a band (Hz)."""
    half_width = max(mode.damping_ratio, 0.0) * mode.frequency
    highest = min(MAX_IN_BAND * band[1], band[1] - half_width)
    return not band[0] + half_width <= mode.frequency <= highest


def rejection_reason(
    mode: IdentifiedMode,
    duration: float,
    band: tuple[float, float],
    min_collinearity: float = MIN_COLLINEARITY,
) -> str:
    """Reason why a mode found in `duration` seconds is not well identified; empty if it is."""
    if is_at_edge(mode, band):
        return "at the edge of the band"
    half = mode.quantile * mode.damping_sd
    if not half < mode.damping_ratio:
        if mode.damping_ratio + half < MIN_STRUCTURAL_DAMPING:
            return "hum: damped less than any structure, and no more than by chance"
        found = f"{100 * mode.damping_ratio:.2g} % +- {100 * half:.2g} %"
        return f"damping uncertain, {found}: too weak, or too short a log"
    if mode.damping_ratio > MAX_DAMPING_RATIO:
        return "damped so strongly that it may be no mode"
    if mode.frequency * duration < MIN_CYCLES:
        return "too few cycles in the window"
    if mode.frequency_sd > MAX_RELATIVE_FREQUENCY_SD * mode.frequency:
        return f"frequency uncertain by {100 * mode.frequency_sd / mode.frequency:.1f} %"
    if mode.energy_share < MIN_ENERGY:
        return f"{100 * mode.energy_share:.2f} % of the energy"
    if mode.shape.size >= 3 and mode.collinearity < min_collinearity:
        return f"a complex shape (modal phase collinearity {mode.collinearity:.2f})"
    return ""

"""Natural frequencies and damping ratios from a log whose excitation is unknown.

    fit = identify_modes(read_log("run.lvm"))
    print(fit)
    fit.plot("modes.png")

A log with a free decay, say after a load has left the beam, is fitted by poles (`decay_poles`);
a log without one is treated as the response to ambient excitation (`ambient`). Modes that the log
determines well are the result; others are listed with the reason for rejecting them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tuning.logs.log import Log
from tuning.modal.ambient import fit_ambient
from tuning.modal.decay_fit import fit_decay, trim_to_free_decay
from tuning.modal.result import IdentifiedMode, ModeCandidates
from tuning.modal.window import DECAY_ENERGY_SHARE, energy_band, find_decay

MIN_SAMPLES = 64
# Cycles of a free decay: in steady random vibration, too, a few cycles look like a decay.
MIN_DECAY_CYCLES = 10.0
MAX_RESIDUAL_ENERGY = 0.25  # share of the energy that the modes of a free decay do not explain
KINDS = ("free decay", "ambient")


@dataclass(frozen=True, eq=False)
class ModalFit:
    """Modes identified from a log, ascending in frequency.

    `modes` are those well identified, `rejected` the others with the reason. `kind` is "free
    decay" or "ambient"; `window` (s) and `band` (Hz) are those of the fit. `quantile` times a
    standard deviation is half a 95 % interval (Student's t, as the noise level is estimated, too).
    `times` and `measured` are the log in the window and the band, `fitted` is the response of the
    modes to it for a free decay, else None.
    """

    modes: tuple[IdentifiedMode, ...]
    rejected: tuple[tuple[IdentifiedMode, str], ...]
    kind: str
    window: tuple[float, float]
    band: tuple[float, float]
    quantile: float
    log: Log
    times: Float[np.ndarray, " sample"]
    measured: Float[np.ndarray, "sample channel"]
    fitted: Float[np.ndarray, "sample channel"] | None

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
        half = self.quantile * np.array([mode.frequency_sd for mode in self.modes])
        return self.frequencies[:, None] + np.multiply.outer(half, [-1.0, 1.0])

    @property
    def damping_intervals(self) -> Float[np.ndarray, "mode 2"]:
        """95 % intervals of the damping ratios."""
        half = self.quantile * np.array([mode.damping_sd for mode in self.modes])
        return self.damping_ratios[:, None] + np.multiply.outer(half, [-1.0, 1.0])

    def __str__(self) -> str:
        start, stop = self.window
        low, high = self.band
        lines = [
            f"{self.log.source}: {self.kind} from {start:.3f} s to {stop:.3f} s, "
            f"{low:.3g} Hz to {high:.4g} Hz",
        ]
        if self.modes:
            lines.append("  frequency (Hz)  +- 95 %    damping ratio  +- 95 %     energy")
        else:
            lines.append("  no mode is well identified")
        for mode in self.modes:
            lines.append(
                f"  {mode.frequency:14.4f}  {self.quantile * mode.frequency_sd:7.4f}    "
                f"{mode.damping_ratio:13.5f}  {self.quantile * mode.damping_sd:7.5f}    "
                f"{100 * mode.energy_share:5.1f} %"
            )
        if self.rejected:
            lines.append("  not well identified:")
        for mode, reason in self.rejected:
            lines.append(f"  {mode.frequency:14.4f}  {reason}")
        return "\n".join(lines)

    def to_dict(self) -> dict:
        """Plain numbers for JSON: modes with 95 % intervals, window, band and rejected modes."""
        intervals = zip(self.modes, self.frequency_intervals, self.damping_intervals, strict=True)
        return {
            "kind": self.kind,
            "window_s": list(self.window),
            "band_hz": list(self.band),
            "frequencies_hz": self.frequencies.tolist(),
            "damping_ratios": self.damping_ratios.tolist(),
            "modes": [
                {
                    "frequency_hz": mode.frequency,
                    "frequency_sd_hz": mode.frequency_sd,
                    "frequency_95_hz": frequency.tolist(),
                    "damping_ratio": mode.damping_ratio,
                    "damping_sd": mode.damping_sd,
                    "damping_95": damping.tolist(),
                    "energy_share": mode.energy_share,
                }
                for mode, frequency, damping in intervals
            ],
            "rejected": [
                {"frequency_hz": mode.frequency, "damping_ratio": mode.damping_ratio, "why": why}
                for mode, why in self.rejected
            ],
        }

    def plot(self, path=None):
        """Figure of log, spectrum and fit; saved to `path` if given."""
        from tuning.modal.plot import plot_modal_fit

        return plot_modal_fit(self, path)


def identify_modes(
    log: Log,
    *,
    window: tuple[float, float] | None = None,
    band: tuple[float, float] | None = None,
    count: int | None = None,
    kind: str | None = None,
) -> ModalFit:
    """Modes from a log of unknown excitation.

    `window` (s) is the part of the log to use, by default that of the free decay; `band` (Hz) the
    range of frequencies, by default that of the kinetic energy; `count` modes are kept, those with
    most energy; `kind` is "free decay" or "ambient", by default decided from the log.

    Raises ValueError for a log that is not sampled evenly or is too short, a window outside the
    log, a band above half the sampling rate, a count below 1 and an unknown kind.
    """
    rate = log.sample_rate
    start, stop = _sample_range(log, window)
    _check_arguments(log, rate, band, count, kind, stop - start)
    found = None
    if kind != "ambient":
        found, used_band = _fit_free_decay(log, rate, start, stop, window, band)
        if (
            found is not None
            and kind is None
            and not _is_free_decay(found, rate, MIN_DECAY_CYCLES if window is None else 0.0)
        ):
            found = None
    is_decay = found is not None
    if kind == "free decay" and not is_decay:
        raise ValueError(f"{log.source}: no free decay found; give its window, or kind='ambient'")
    if not is_decay:
        used_band = band or energy_band(log.values[start:stop], rate, log.quantities)
        found = fit_ambient(log.values, rate, start, stop, used_band, log.quantities)
    modes = [
        mode for mode, why in zip(found.modes, found.rejection_reasons, strict=True) if not why
    ]
    rejected = [
        (mode, why) for mode, why in zip(found.modes, found.rejection_reasons, strict=True) if why
    ]
    modes.sort(key=lambda mode: -mode.energy_share)
    if count is not None:
        rejected += [(mode, f"not among the {count} of most energy") for mode in modes[count:]]
        modes = modes[:count]
    return ModalFit(
        modes=tuple(sorted(modes)),
        rejected=tuple(sorted(rejected)),
        kind="free decay" if is_decay else "ambient",
        window=(float(log.times[found.start]), float(log.times[found.stop - 1])),
        band=used_band,
        quantile=found.quantile,
        log=log,
        times=log.times[found.start : found.stop],
        measured=found.measured,
        fitted=found.fitted,
    )


def _fit_free_decay(
    log, rate, start, stop, window, band
) -> tuple[ModeCandidates | None, tuple[float, float]]:
    """Fit of the free decay in the given window or the one found, and its band (Hz)."""
    limits = band or (0.0, rate / 2)
    if window is None:
        found = find_decay(log.values, rate, band, log.quantities)
        if found is None:
            return None, limits
        start, stop = found
        decay_band = energy_band(log.values[start:stop], rate, log.quantities, DECAY_ENERGY_SHARE)
        start, stop = trim_to_free_decay(log.values, rate, start, stop, band or decay_band)
    limits = band or energy_band(log.values[start:stop], rate, log.quantities)
    return fit_decay(log.values, rate, start, stop, limits), limits


def _is_free_decay(found: ModeCandidates, rate: float, least_cycles: float) -> bool:
    """Whether modes explain most of the energy, over many cycles, as in a free decay."""
    duration = (found.stop - found.start) / rate
    residual_energy = np.sum((found.measured - found.fitted) ** 2) / np.sum(found.measured**2)
    good = [mode for mode, why in zip(found.modes, found.rejection_reasons, strict=True) if not why]
    cycles = max(good, key=lambda mode: mode.energy_share).frequency * duration if good else 0.0
    return bool(cycles > least_cycles and residual_energy < MAX_RESIDUAL_ENERGY)


def _sample_range(log: Log, window) -> tuple[int, int]:
    """First and last (exclusive) sample of a window (s)."""
    if window is None:
        return 0, log.times.size
    if not (log.times[0] <= window[0] < window[1] <= log.times[-1] + 1 / log.sample_rate):
        raise ValueError(
            f"{log.source}: the window from {window[0]:g} s to {window[1]:g} s is not within the "
            f"log, {log.times[0]:.6g} s to {log.times[-1]:.6g} s"
        )
    start, stop = np.searchsorted(log.times, window)
    return int(start), int(stop)


def _check_arguments(log: Log, rate, band, count, kind, samples) -> None:
    if samples < MIN_SAMPLES:
        raise ValueError(
            f"{log.source}: {samples} samples are too few to identify modes from; "
            f"at least {MIN_SAMPLES} are needed"
        )
    if band is not None and not 0 <= band[0] < band[1] <= rate / 2:
        raise ValueError(
            f"{log.source}: the band from {band[0]:g} Hz to {band[1]:g} Hz is not within 0 and "
            f"half the sampling rate, {rate / 2:g} Hz"
        )
    if count is not None and count < 1:
        raise ValueError(f"count must be at least 1, not {count}")
    if kind not in (None, *KINDS):
        raise ValueError(f"kind must be {' or '.join(map(repr, KINDS))}, not {kind!r}")

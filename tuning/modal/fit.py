"""Modes identified from a log, with the automatic choices that were made."""

import os
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.files.endings import check_ending
from jaxbeam.runtime.output_file import whole_file
from tuning.logs.log import Log
from tuning.modal.ambient import MAX_BAND_RATIO
from tuning.modal.harmonics import Line
from tuning.modal.result import Channels, IdentifiedMode, ModalEstimates, channels_of
from tuning.modal.subspace import Diagram


class Choice(NamedTuple):
    """An automatic choice, and the option that overrides it."""

    text: str
    option: str


@dataclass(frozen=True, eq=False)
class ModalFit(ModalEstimates):
    """Modes identified from a log, ascending in frequency.

    `modes` are those well identified, `rejected` the others with the reason. `kind` is "free
    decay", "ambient" or "measured force"; `windows` (s) are the parts of the log used, `band` (Hz)
    that of the search; `lines` are harmonic lines that were subtracted. `choices` are the automatic
    choices, `notes` sentences on the log. `diagrams` are stabilisation diagrams, one for each part
    of the band. `times` and `measured` are the log in the first window and the band, `fitted` is
    the response of the modes to it for a free decay, else None.

    >>> import numpy as np
    >>> import tuning
    >>> times = 0.005 * np.arange(1600)
    >>> decay = np.exp(-0.3 * times) * np.cos(2 * np.pi * 3.2 * times)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=times.size)
    >>> columns = ("a1",), ("acceleration",), ("m/s^2",)
    >>> fit = tuning.identify_modes(tuning.Log(times, (decay + noise)[:, None], *columns))
    >>> print(f"{fit.frequencies[0]:.2f} Hz, damping ratio {fit.damping_ratios[0]:.4f}")
    3.20 Hz, damping ratio 0.0149
    """

    modes: tuple[IdentifiedMode, ...]
    rejected: tuple[tuple[IdentifiedMode, str], ...]
    kind: str
    method: str
    windows: tuple[tuple[float, float], ...]
    band: tuple[float, float]
    lines: tuple[Line, ...]
    choices: tuple[Choice, ...]
    notes: tuple[str, ...]
    diagrams: tuple[Diagram, ...]
    log: Log
    times: Float[np.ndarray, " sample"]
    measured: Float[np.ndarray, "sample channel"]
    fitted: Float[np.ndarray, "sample channel"] | None

    @property
    def window(self) -> tuple[float, float]:
        """Start and end (s) of the part of the log that was used."""
        return self.windows[0][0], self.windows[-1][1]

    @property
    def channels(self) -> Channels:
        """Channels of the log."""
        return channels_of(self.log)

    @property
    def source(self) -> str:
        """Name of the log."""
        return self.log.source

    def __str__(self) -> str:
        (start, stop), (low, high) = self.window, self.band
        several = f" ({len(self.windows)} decays)" if len(self.windows) > 1 else ""
        lines = [
            f"{self.log.source}: {self.kind} from {start:.3f} s to {stop:.3f} s{several}, "
            f"{low:.3g} Hz to {high:.4g} Hz",
            *(f"  {note}" for note in self.notes),
            *(f"  {choice.text}  [{choice.option}]" for choice in self.choices),
        ]
        if self.lines:
            listed = ", ".join(
                f"{one.frequency:.3f} Hz ({100 * one.share:.2g} %)" for one in self.lines
            )
            lines.append(f"  harmonic lines, no modes (share of the variance): {listed}")
        if self.modes and high > MAX_BAND_RATIO * low:
            lines.append("  energy: share of that in the three octaves around the mode")
        lines += self._mode_lines()
        if self.rejected:
            lines.append("  not well identified:  [--choose FREQUENCY]")
        for mode, reason in self.rejected:
            lines.append(f"  {mode.frequency:14.4f}  {reason}")
        return "\n".join(lines)

    def to_dict(self) -> dict:
        """Plain numbers for JSON: modes with 95 % intervals and shapes, and automatic choices."""
        return {
            "kind": self.kind,
            "method": self.method,
            "window_s": list(self.window),
            "windows_s": [list(window) for window in self.windows],
            "band_hz": list(self.band),
            "channels": list(self.log.names),
            "choices": [{"choice": c.text, "option": c.option} for c in self.choices],
            "notes": list(self.notes),
            "harmonic_lines": [
                {"frequency_hz": line.frequency, "share": line.share} for line in self.lines
            ],
            "frequencies_hz": self.frequencies.tolist(),
            "damping_ratios": self.damping_ratios.tolist(),
            "modes": [mode.to_dict() for mode in self.modes],
            "mac": self.mac.tolist(),
            "rejected": [
                {"frequency_hz": mode.frequency, "damping_ratio": mode.damping_ratio, "why": why}
                for mode, why in self.rejected
            ],
        }

    def to_html(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the stabilisation diagram, in which modes are chosen by clicks, as a page.

        Raises ValueError for another ending than .html and a fit without a diagram,
        FileExistsError if the file exists, without `overwrite`.
        """
        from tuning.modal.plot import diagram_page

        check_ending(path, "an interactive figure", (".html",))
        page = diagram_page(self)
        with whole_file(path, overwrite) as partial:
            partial.write_text(page, encoding="utf-8")

    def plot(self, path=None, length: float | None = None):
        """Figure of log, spectrum with stabilisation diagram, fit, and shapes on the beam.

        `length` (m) is that of the beam; it is saved to `path` if given.
        """
        from tuning.modal.plot import plot_modal_fit

        return plot_modal_fit(self, path, length)

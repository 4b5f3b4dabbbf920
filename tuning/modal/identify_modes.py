"""Natural frequencies, damping ratios and mode shapes from logs whose excitation is unknown.

    fit = identify_modes(read_log("run.lvm"))
    print(fit)
    fit.plot("modes.png")

The excitation is recognised: free decays, after one impact or many or after a load has left the
beam, are fitted together by poles (`decay.poles`), starting from those of a subspace method; all
else is a response to ambient excitation (`ambient`). Harmonic lines
are subtracted. Modes that the log determines well are the result; others are listed with the reason
for rejecting them.
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.fields import refuses_traced
from jaxbeam.runtime.output_file import check_ending, whole_file
from tuning.logs.log import Log
from tuning.logs.quality import sensor_readings
from tuning.modal.ambient import MAX_BAND_RATIO, Candidate, subspace_modes
from tuning.modal.decay.excitation import impacts_left_out
from tuning.modal.decay.modes import Decays, find_excited, free_decay_modes, modes_of_decays
from tuning.modal.forced.measured_responses import (
    Windows,
    check_windows,
    force_at_impacts,
    force_names,
    force_records,
    without_forces,
)
from tuning.modal.forced.modes import forced_modes
from tuning.modal.harmonics import (
    Line,
    band_of,
    band_without_lines,
    fundamental,
    is_multiple,
    lines_besides,
    steady_candidates,
)
from tuning.modal.preprocessing import (
    Samples,
    energy_band,
    kinetic_band,
    prepare,
    samples_of,
    time_derivative,
    with_channels,
    without_constant,
)
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

    @checks_classes
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


KINDS = ("free decay", "ambient")
DECAY = "decay"  # the method for free decays; the others are for responses to broadband forces
MOST_ORDER = 1000  # of a model, the work for which grows with its fourth power
METHODS = (DECAY, "covariance", "data", "plscf")  # the last is for measured forces


@dataclass(frozen=True)
class ModalSettings:
    """Settings of `identify_modes`, apart from the part of the log and the method.

    `count` modes are kept, those with most energy. `exclude` are frequencies (Hz) that are no
    modes. The modes nearest to the frequencies `choose` (Hz) are kept, also those that are not well
    identified, and no others. `order` is the highest order of the stabilisation diagram. `force`
    are the names of the channels of forces that were measured, of a hammer or shaker, by default
    all in N; a force that one of several logs lacks, as of a hammer that strikes another place in
    each, is zero there. `force_window` (s) is the time after each impact of a hammer from which on
    the force is taken for zero. Readings that a logger repeats are decimated, and zeros before a
    sensor has answered interpolated, but with samples `as_logged`.

    Raises ValueError for a count below one, an order below four or above MOST_ORDER, frequencies
    to choose that are not positive, and a choice with a count or excluded frequencies, as it
    chooses all modes.

        >>> ModalSettings(count=3, exclude=[50.0]).count
        3
        >>> ModalSettings(count=0)
        Traceback (most recent call last):
            ...
        ValueError: count must be at least 1, not 0
    """

    count: int | None = None
    exclude: Sequence[float] = ()
    choose: Sequence[float] = ()
    order: int | None = None
    force: Sequence[str] | None = None
    force_window: float | None = None
    as_logged: bool = False

    def __post_init__(self):
        if self.count is not None and self.count < 1:
            raise ValueError(f"count must be at least 1, not {self.count}")
        if self.order is not None and not 4 <= self.order <= MOST_ORDER:
            raise ValueError(f"the highest order must be from 4 to {MOST_ORDER}, not {self.order}")
        wrong = [frequency for frequency in self.choose if not 0 < frequency < float("inf")]
        if wrong:
            raise ValueError(f"modes are chosen by frequencies above 0 Hz, not {wrong[0]:g} Hz")
        if len(self.choose) and (self.count is not None or len(self.exclude)):
            other = "exclude" if self.count is None else "count"
            raise ValueError(f"chosen modes are all that are kept; leave out {other}")
        check_windows(Windows(force=self.force_window))


def check_band(log: Log, rate: float, band: tuple[float, float] | None) -> None:
    """Check a band (Hz) for a log of some sampling rate (Hz).

    Raises ValueError for a band that ends before it begins, or that is not within 0 and half the
    sampling rate.
    """
    if band is not None and band[0] >= band[1]:
        raise ValueError(
            f"{log.source}: the band from {band[0]:g} Hz to {band[1]:g} Hz must end above where it "
            "begins"
        )
    if band is not None and not 0 < band[0] < band[1] <= rate / 2:
        raise ValueError(
            f"{log.source}: the band from {band[0]:g} Hz to {band[1]:g} Hz is not within 0 and "
            f"half the sampling rate, {rate / 2:g} Hz"
        )


def check_force(settings: ModalSettings, kind: str | None, method: str | None) -> None:
    """Check that a measured force, or its window, is used.

    Raises ValueError for either with a kind, or with a method that does not use it.
    """
    if settings.force is None and settings.force_window is None:
        return
    if method not in (None, "plscf"):
        raise ValueError(f"a measured force is used by method 'plscf', not by {method!r}")
    if kind is not None:
        raise ValueError(f"with a measured force the excitation is known; leave out kind {kind!r}")


def check_method(kind: str | None, method: str | None) -> None:
    """Check the kind of excitation and the method.

    Raises ValueError for an unknown kind or method, and a kind that the method cannot use.
    """
    if kind not in (None, *KINDS):
        raise ValueError(f"kind must be {' or '.join(map(repr, KINDS))}, not {kind!r}")
    if method == "fdd":
        raise ValueError(
            "method 'fdd' is gone: other methods find more modes and smaller errors of damping; "
            "use 'covariance' or 'data'"
        )
    if method not in (None, *METHODS):
        raise ValueError(f"method must be {' or '.join(map(repr, METHODS))}, not {method!r}")
    if kind == "free decay" and method not in (None, DECAY):
        raise ValueError(
            f"method {method!r} takes a log for the response to broadband excitation; for kind "
            "'free decay' leave the method out"
        )
    if kind == "ambient" and method == "plscf":
        raise ValueError(
            "method 'plscf' fits the responses to measured forces; for kind 'ambient' use "
            "'covariance' or 'data'"
        )
    if kind == "ambient" and method == DECAY:
        raise ValueError("method 'decay' fits free decays; for kind 'ambient' leave the method out")


MAX_DISTANCE = 0.02  # relative distance of a mode from the frequency that chooses it

Judged = tuple[IdentifiedMode, str]  # a mode and the reason for rejecting it, or none


def chosen_modes(
    judged: Sequence[Judged], frequencies: Sequence[float], source: str
) -> tuple[list[Judged], list[Judged], list[str]]:
    """The modes nearest to frequencies (Hz), the others, and warnings about chosen ones.

    Raises ValueError for a frequency without a mode within 2 %, and for two that choose one mode.
    """
    chosen: dict[int, float] = {}
    notes = []
    for frequency in frequencies:
        places = sorted(range(len(judged)), key=lambda k: abs(judged[k][0].frequency - frequency))
        found = judged[places[0]][0].frequency if places else math.inf
        if abs(found - frequency) > MAX_DISTANCE * frequency:
            near = f"the nearest is {found:.4g} Hz" if places else "there are none"
            raise ValueError(
                f"{source}: no pole within {100 * MAX_DISTANCE:g} % of the chosen {frequency:g} Hz;"
                f" {near}. Choose frequencies that are printed without a choice"
            )
        nearest = places[0]
        if nearest in chosen:
            raise ValueError(
                f"{source}: {chosen[nearest]:g} Hz and {frequency:g} Hz choose one mode, that of"
                f" {found:.4g} Hz; give one of them, or frequencies nearer to two modes"
            )
        chosen[nearest] = frequency
        if reason := judged[nearest][1]:
            notes.append(f"{found:.4g} Hz is chosen, though {reason}")
    others = [
        (mode, reason or "not chosen") for k, (mode, reason) in enumerate(judged) if k not in chosen
    ]
    return [(judged[k][0], "") for k in chosen], others, notes


FORCED = "measured force"
NARROW = 0.005  # damping ratio of a mode below which it may be a harmonic
MIN_TRANSIENT_SAMPLES = 0.01  # excited samples of a log with transients of crossing loads


@refuses_traced("a modal fit")
def identify_modes(
    log: Log | Sequence[Log],
    *,
    window: tuple[float, float] | None = None,
    band: tuple[float, float] | None = None,
    kind: str | None = None,
    method: str | None = None,
    channels: Sequence[str] | None = None,
    settings: ModalSettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> ModalFit:
    """Modes from a log, or from several of the same channels, of unknown excitation.

    `window` (s) is the part of the log to use; `band` (Hz) the range of frequencies, by default
    that of the resonances with most kinetic energy; `kind` is "free decay" or "ambient", by default
    decided from the log; `method` is "decay" (poles of free decays), "covariance" or "data"
    (subspace identification), which take a log for the response to broadband excitation; where
    forces were measured, "plscf" (poly-reference least-squares complex frequency) fits the
    responses to them, and is the default. `channels` are the names of those to use. `settings` has
    further choices. `progress` is called with a few words on what is being done.

    Raises ValueError for a log without evenly sampled records, or too short, a window outside the
    log, a band above half the sampling rate, unknown channels, kinds and methods, a kind or forces
    that the method cannot use, channels that are no forces, a force window without impacts,
    frequencies to choose that have no pole within 2 %, and logs that differ in channels or sampling
    rate.

    >>> import numpy as np
    >>> import tuning
    >>> times = 0.005 * np.arange(1600)
    >>> decay = np.exp(-0.3 * times) * np.cos(2 * np.pi * 3.2 * times)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=times.size)
    >>> columns = ("a1",), ("acceleration",), ("m/s^2",)
    >>> fit = tuning.identify_modes(tuning.Log(times, (decay + noise)[:, None], *columns))
    >>> [f"{frequency:.2f} Hz" for frequency in fit.frequencies]
    ['3.20 Hz']
    """
    logs = [log] if isinstance(log, Log) else list(log)
    settings = settings or ModalSettings()
    logs = logs if settings.as_logged else [sensor_readings(one) for one in logs]
    check_method(kind, method)
    check_force(settings, kind, method)
    order, force_window = settings.order, settings.force_window
    measured = logs
    forces = () if kind or method not in (None, "plscf") else force_names(logs, settings.force)
    logs, dead = without_constant([without_forces(with_channels(one, channels)) for one in logs])
    if not forces and force_window is not None:
        raise ValueError(f"{logs[0].source}: a force window is for measured forces; none is in N")
    if not forces and method == "plscf":
        raise ValueError(
            f"{logs[0].source}: method 'plscf' fits the responses to measured forces, and none is "
            "in N; without them use 'covariance' or 'data'"
        )
    samples = samples_of(logs, window).with_notes(dead)
    check_band(logs[0], samples.rate, band)
    choices = _joint_analysis(logs)
    derivatives = tuple(time_derivative(name) for name in logs[0].quantities)
    if forces:
        used_band = band or energy_band(samples.records, samples.rate, derivatives)
        driving = force_records(measured, forces, window, samples)
        if force_window is not None:
            driving = tuple(force_at_impacts(one, samples.rate, force_window) for one in driving)
        if progress:
            progress("responses to the measured forces")
        found, explained = _forced(samples, driving, used_band, order, progress)
        choices.append(
            Choice(
                f"excitation: measured force {' and '.join(forces)}, which explains "
                f"{100 * explained:.1f} % of the responses in the band",
                "--force CHANNEL, or --method covariance without it",
            )
        )
        _add_order(choices, order, found)
        choices = [*_band_choice(band, used_band), *choices]
        return _result(logs, samples, found, used_band, (), choices, "plscf", settings)
    if progress:
        progress("harmonic lines and excitation")
    wide, lines, cleaned = band_without_lines(samples, derivatives, settings.exclude, band)
    readings_differ = band is None and set(derivatives) != {1}  # from velocities
    used_band = wide
    if readings_differ:
        used_band = band_of(kinetic_band, samples, derivatives, cleaned if lines else None)
    excited = find_excited(samples, derivatives, used_band)
    kind = "free decay" if method == DECAY else kind
    how = {"kind": kind, "whole": window is not None, "order": order}
    of_decays, may_decay = None, kind != "ambient" and method in (None, DECAY)
    if may_decay:
        bands, narrow = (used_band, wide), band is None
        of_decays = modes_of_decays(samples, excited, derivatives, bands, narrow, how)
    found, used_band = (_Found(*of_decays[:3]), of_decays.band) if of_decays else (None, wide)
    if kind == "free decay" and found is None:
        raise ValueError(f"{logs[0].source}: no free decay found; give its window, or kind ambient")
    used_method = method or "covariance"
    if found is None:
        found = _ambient_modes(cleaned, samples, used_band, used_method, order, progress)
        if may_decay and window is None and all(one.reason for one in found.candidates):
            # The energy of a short decay falls little, but damped vibrations explain all of it.
            how["whole"] = True
            whole = free_decay_modes(samples, excited, derivatives, used_band, **how)
            found = _Found(*whole) if whole else found
    if found.decays is None:
        if lines:
            choices.append(Choice(f"{len(lines)} harmonic lines subtracted", "--exclude FREQUENCY"))
        wandering, doubtful = steady_candidates(found.candidates, cleaned, samples, used_band)
        lines += wandering
        choices += [
            Choice(
                f"{frequency:.4g} Hz vibrates more steadily than 99 of 100 resonances: "
                "a mode, if no machine drives it",
                f"--exclude {frequency:.4g}",
            )
            for frequency in doubtful
        ]
    else:
        used_method = DECAY
        choices += [
            Choice(text, "--from and --to")
            for text in impacts_left_out(samples, excited, found.decays.stretches, used_band)
        ]
        lines = lines_besides(lines, [one.mode for one in found.candidates if not one.reason])
    if kind is None:
        says = _kind_words(found, excited, lines)
        choices.append(Choice(says, "--kind ambient, --kind 'free decay', --from and --to"))
    if method is None:
        choices.append(Choice(f"method {used_method}", f"--method {', '.join(METHODS[:-1])}"))
    _add_order(choices, order, found)
    choices = [*_band_choice(band, used_band), *choices]
    return _result(logs, samples, found, used_band, lines, choices, used_method, settings)


def _joint_analysis(logs: Sequence[Log]) -> list[Choice]:
    """Choice to analyse several logs jointly; none for a single log."""
    if len(logs) == 1:
        return []
    text = f"{len(logs)} logs of the same channels, used together"
    return [Choice(text, "--references NAME,NAME,... if other sensors moved")]


def _band_choice(band, used: tuple[float, float]) -> list[Choice]:
    """Choice of the band that was used; none if the user gave it."""
    if band is not None:
        return []
    return [Choice(f"band {used[0]:.3g} Hz to {used[1]:.4g} Hz", "--band LOW:HIGH")]


class _Found(NamedTuple):
    """Result of a method: candidates, diagrams, fitted decays if any, and kind of excitation."""

    candidates: tuple[Candidate, ...]
    diagrams: tuple[Diagram, ...]
    decays: Decays | None
    kind: str = "ambient"


def _add_order(choices, order, found: _Found) -> None:
    if order is None and found.diagrams:
        highest = max((max(d.orders, default=0) for d in found.diagrams), default=0)
        choices.append(Choice(f"models of orders to {highest}", "--order N"))


def _forced(samples: Samples, driving, band, order, progress) -> tuple[_Found, float]:
    """Modes of the responses to measured forces, and the fraction of these that they explain."""
    arguments = (samples.records, driving, samples.rate, band)
    found = forced_modes(*arguments, order=order, progress=progress)
    return _Found(found.candidates, found.diagrams, None, kind=FORCED), found.explained


def _ambient_modes(cleaned, samples: Samples, band, method, order, progress) -> _Found:
    """Modes that a method for ambient excitation finds in records without harmonic lines."""
    arguments = (cleaned, samples.starts, samples.rate, band)
    data_driven = method == "data"
    found = subspace_modes(*arguments, data_driven=data_driven, order=order, progress=progress)
    return _Found(*found, None)


def _kind_words(found: _Found, excited, lines) -> str:
    """Sentence on the excitation."""
    if found.decays is not None:
        number = len(found.decays.stretches)
        return f"excitation: {number} free decays, used together" if number > 1 else (
            "excitation: a free decay"
        )  # fmt: skip
    if sum(line.share for line in lines) > 0.5:
        return "excitation: steady shaking, whose harmonic lines are no modes, and ambient"
    if np.mean(np.concatenate(excited)) > MIN_TRANSIENT_SAMPLES:
        return "excitation: transients (crossing loads or impacts) without a clear free decay"
    return "excitation: ambient"


def _result(logs, samples, found: _Found, band, lines, choices, method, keep: ModalSettings):
    """The fit: candidates divided into modes and rejected ones."""
    longest = max(len(record) for record in samples.records)
    resolution = samples.rate / longest
    speed = fundamental(lines, samples.rate, longest) if found.decays is None else None
    modes, rejected = [], []
    for candidate in found.candidates:
        mode, reason = candidate.mode, candidate.reason
        mode = mode._replace(energy_share=float(np.clip(mode.energy_share, 0.0, 1.0)))
        near = [f for f in keep.exclude if abs(mode.frequency - f) < max(0.01 * f, 3 * resolution)]
        hit = [one for one in lines if abs(mode.frequency - one.frequency) < 2 * resolution]
        if near:
            reason = f"excluded, {near[0]:g} Hz"
        elif hit and found.decays is None and mode.damping_ratio < 0.002:
            reason = f"a harmonic line, {hit[0].frequency:.3f} Hz"
        elif mode.damping_ratio < NARROW and is_multiple(
            mode.frequency, max(0.5 * resolution, 2 * mode.frequency_sd), speed
        ):
            reason = f"narrow, and a multiple of the lines' {speed:.3f} Hz"
        elif any(one.pole == mode.pole for one in lines):
            reason = "of steady amplitude: a harmonic line that wanders"
        (rejected if reason else modes).append((mode, reason))
    modes.sort(key=lambda pair: -pair[0].energy_share)
    if keep.count is not None:
        reason = f"not among the {keep.count} of most energy"
        rejected += [(mode, reason) for mode, _ in modes[keep.count :]]
        modes = modes[: keep.count]
    notes = list(samples.notes)
    if len(keep.choose):
        modes, rejected, said = chosen_modes([*modes, *rejected], keep.choose, logs[0].source)
        notes += said
    if found.decays is None:
        windows = tuple(
            (start, start + (len(record) - 1) / samples.rate)
            for start, record in zip(samples.starts, samples.records, strict=True)
        )
        prepared = prepare(samples.records[:1], samples.starts[:1], samples.rate, band)
        measured, fitted = prepared.records[0], None
        times = samples.starts[0] + np.arange(len(measured)) / prepared.rate
    else:
        used, measured, fitted = found.decays
        length = len(measured) - 1
        windows = tuple(
            (samples.starts[d.record] + d.start / samples.rate,
             samples.starts[d.record] + (d.start + length) / samples.rate)
            for d in used
        )  # fmt: skip
        times = windows[0][0] + np.arange(len(measured)) / samples.rate
    return ModalFit(
        modes=tuple(sorted((mode for mode, _ in modes), key=lambda mode: mode.frequency)),
        rejected=tuple(sorted(rejected, key=lambda pair: pair[0].frequency)),
        kind=found.kind if found.decays is None else "free decay",
        method=method,
        windows=windows,
        band=band,
        lines=lines,
        choices=tuple(choices),
        notes=tuple(notes),
        diagrams=found.diagrams,
        log=logs[0],
        times=times,
        measured=measured,
        fitted=fitted,
    )

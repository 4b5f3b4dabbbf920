"""Natural frequencies, damping ratios and mode shapes from logs whose excitation is unknown.

    fit = identify_modes(read_log("run.lvm"))
    print(fit)
    fit.plot("modes.png")

The excitation is recognised: free decays, after one blow or many or after a load has left the beam,
are fitted together by poles (`decay_poles`), starting from those of a subspace method; all else is
a response to ambient excitation (`ambient`). Harmonic lines are subtracted. Modes that the log
determines well are the result; others are listed with the reason for rejecting them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.logs.log import Log
from tuning.logs.quality import find_faults
from tuning.logs.records import even_records
from tuning.logs.units import time_derivative
from tuning.modal.ambient import Candidate, subspace_modes
from tuning.modal.decay_fit import fit_decay
from tuning.modal.decays import Stretch, free_decays, stacked
from tuning.modal.fit import Choice, ModalFit
from tuning.modal.harmonics import harmonic_lines, without_lines
from tuning.modal.preprocessing import kinetic_band, prepare, strongest_frequency
from tuning.modal.stabilisation import Diagram

MIN_SAMPLES = 64
KINDS = ("free decay", "ambient")
METHODS = ("covariance", "data")
MIN_DECAY_ENERGY = 0.3  # share of the energy of a log in its decays, if they are to stand for it
LONG_FALL_NEPERS = 3.5  # or fall of the energy that steady random vibration hardly shows
MAX_RESIDUAL_ENERGY = 0.25  # share of the energy that the modes of a free decay do not explain
MAX_RESIDUAL_OF_WINDOW = 0.05  # the same for a window that the user gives and that falls little
TRANSIENT_SHARE = 0.01  # struck samples of a log with transients of crossing loads


class _Samples(NamedTuple):
    """Records of all logs in SI units, with the times of their first samples (s)."""

    records: tuple[Float[np.ndarray, "time channel"], ...]
    starts: tuple[float, ...]
    rate: float
    notes: tuple[str, ...]


def identify_modes(
    log: Log | Sequence[Log],
    *,
    window: tuple[float, float] | None = None,
    band: tuple[float, float] | None = None,
    count: int | None = None,
    kind: str | None = None,
    channels: Sequence[str] | None = None,
    order: int | None = None,
    method: str | None = None,
    exclude: Sequence[float] = (),
    progress: Callable[[str], None] | None = None,
) -> ModalFit:
    """Modes from a log, or from several of the same channels, of unknown excitation.

    `window` (s) is the part of the log to use; `band` (Hz) the range of frequencies, by default
    that of the resonances with most kinetic energy; `count` modes are kept, those with most energy;
    `kind` is "free decay" or "ambient", by default decided from the log; `channels` are the names
    of those to use; `order` is the highest order of the stabilisation diagram; `method` is
    "covariance" or "data" (subspace identification); `exclude` are frequencies (Hz) that are no
    modes. `progress` is called with a few words on what is being done.

    Raises ValueError for a log without evenly sampled records, or too short, a window outside the
    log, a band above half the sampling rate, an impossible count or order, unknown channels, kinds
    and methods, and logs that differ in channels or sampling rate.
    """
    logs = [log] if isinstance(log, Log) else list(log)
    _check_arguments(count, kind, order, method)
    logs = [_with_channels(one, channels) for one in logs]
    samples = _samples(logs, window)
    _check_band(logs[0], samples.rate, band)
    choices = []
    derivatives = tuple(time_derivative(name) for name in logs[0].quantities)
    used_band = band or kinetic_band(samples.records, samples.rate, derivatives)
    if band is None:
        choices.append(
            Choice(f"band {used_band[0]:.3g} Hz to {used_band[1]:.4g} Hz", "--band LOW:HIGH")
        )
    if progress:
        progress("harmonic lines and excitation")
    lines, cleaned = _subtract_lines(samples, used_band, exclude)
    if lines:
        choices.append(Choice(f"{len(lines)} harmonic lines subtracted", "--exclude FREQUENCY"))
    found = None
    if kind != "ambient":
        found = _free_decay_modes(samples, cleaned, derivatives, used_band, kind, window, order)
    if kind == "free decay" and found is None:
        raise ValueError(f"{logs[0].source}: no free decay found; give its window, or kind ambient")
    if kind is None:
        says = _kind_words(found, samples, cleaned, used_band, lines)
        choices.append(Choice(says, "--kind ambient, --kind 'free decay', --from and --to"))
    if found is None:
        used_method = method or "covariance"
        candidates, diagrams = subspace_modes(
            cleaned,
            samples.starts,
            samples.rate,
            used_band,
            data_driven=used_method == "data",
            order=order,
            progress=progress,
        )
        found = _Found(candidates, diagrams, None)
    else:
        used_method = "decay"
    if method is None:
        choices.append(Choice(f"method {used_method}", f"--method {', '.join(METHODS)}"))
    if order is None:
        highest = max((max(d.orders, default=0) for d in found.diagrams), default=0)
        choices.append(Choice(f"models of orders to {highest}", "--order N"))
    return _result(logs, samples, found, used_band, lines, choices, used_method, count, exclude)


class _Found(NamedTuple):
    """Candidates, diagrams, and the decays that were fitted with their samples (None: ambient)."""

    candidates: tuple[Candidate, ...]
    diagrams: tuple[Diagram, ...]
    decays: tuple[tuple[Stretch, ...], Float[np.ndarray, "t c"], Float[np.ndarray, "t c"]] | None


def _free_decay_modes(samples, cleaned, derivatives, band, kind, window, order) -> _Found | None:
    """Modes of the free decays in the records; None without any that stand for the log."""
    prepared = prepare(cleaned, samples.starts, samples.rate, band)
    frequency = strongest_frequency(prepared.records, prepared.rate, derivatives, band)
    decays, _ = free_decays(prepared.records, prepared.rate, frequency)
    ratio = samples.rate / prepared.rate
    given = not decays and (kind == "free decay" or window is not None)
    if given:
        decays = tuple(Stretch(i, 0, len(r), 0.0) for i, r in enumerate(prepared.records))
    if not decays or not (kind or given or _dominate(decays, prepared.records)):
        return None
    raw = tuple(
        Stretch(
            one.record,
            int(np.ceil(one.start * ratio)),
            min(int(one.stop * ratio), len(samples.records[one.record])),
            one.fall,
        )
        for one in decays
    )
    windows, used = stacked(samples.records, raw)
    if len(windows) < MIN_SAMPLES // 2:
        return None
    channels = samples.records[0].shape[1]
    pieces = tuple(windows[:, i : i + channels] for i in range(0, windows.shape[1], channels))
    starts = tuple(one.start / samples.rate for one in used)
    candidates, diagrams = subspace_modes(pieces, starts, samples.rate, band, order=order)
    poles = np.array(
        [
            2 * np.pi * c.mode.frequency
            * (-c.mode.damping_ratio + 1j * np.sqrt(1 - c.mode.damping_ratio**2))
            for c in candidates
            if c.length > 1
        ],
        complex,
    )  # fmt: skip
    fit = fit_decay(windows, samples.rate, band, channels, poles)
    if fit is None:
        return None
    residual = np.sum((fit.measured - fit.fitted) ** 2) / max(np.sum(fit.measured**2), 1e-300)
    good = any(not why for why in fit.reasons)
    limit = MAX_RESIDUAL_OF_WINDOW if given else MAX_RESIDUAL_ENERGY
    if kind is None and not (good and residual < limit):
        return None
    found = tuple(Candidate(mode, why, 1) for mode, why in zip(fit.modes, fit.reasons, strict=True))
    return _Found(found, diagrams, (used, fit.measured[:, :channels], fit.fitted[:, :channels]))


def _dominate(decays, records) -> bool:
    """Whether decays hold much of the energy of a log, or fall farther than chance allows."""
    inside = sum(np.sum(records[d.record][d.start : d.stop] ** 2) for d in decays)
    whole = sum(np.sum(record**2) for record in records)
    return bool(inside > MIN_DECAY_ENERGY * whole or max(d.fall for d in decays) > LONG_FALL_NEPERS)


def _kind_words(found, samples, cleaned, band, lines) -> str:
    """Sentence on the excitation."""
    if found is not None and found.decays is not None:
        number = len(found.decays[0])
        return f"excitation: {number} free decays, used together" if number > 1 else (
            "excitation: a free decay"
        )  # fmt: skip
    share = sum(line.share for line in lines)
    if share > 0.5:
        return "excitation: steady shaking, whose harmonic lines are no modes, and ambient"
    prepared = prepare(cleaned, samples.starts, samples.rate, band)
    _, struck = free_decays(prepared.records, prepared.rate, 2 * band[0])
    if struck > TRANSIENT_SHARE:
        return "excitation: transients (crossing loads or blows) without a clear free decay"
    return "excitation: ambient"


def _subtract_lines(samples: _Samples, band, exclude):
    """Harmonic lines, and the records without them and without excluded frequencies."""
    prepared = prepare(samples.records, samples.starts, samples.rate, band)
    longest = max(range(len(samples.records)), key=lambda i: len(samples.records[i]))
    lines = harmonic_lines(prepared.records[longest], prepared.rate, band)
    frequencies = tuple(line.frequency for line in lines) + tuple(exclude)
    centred = (record - record.mean(axis=0) for record in samples.records)
    return lines, tuple(without_lines(one, samples.rate, frequencies) for one in centred)


def _result(logs, samples, found: _Found, band, lines, choices, method, count, exclude):
    """The fit: candidates divided into modes and rejected ones."""
    resolution = samples.rate / max(len(record) for record in samples.records)
    modes, rejected = [], []
    for candidate in found.candidates:
        mode, reason = candidate.mode, candidate.reason
        near = [f for f in exclude if abs(mode.frequency - f) < max(0.01 * f, 3 * resolution)]
        hit = [one for one in lines if abs(mode.frequency - one.frequency) < 2 * resolution]
        if near:
            reason = f"excluded, {near[0]:g} Hz"
        elif hit and not reason and found.decays is None and mode.damping_ratio < 0.002:
            reason = f"a harmonic line, {hit[0].frequency:.3f} Hz"
        (rejected if reason else modes).append((mode, reason))
    modes.sort(key=lambda pair: -pair[0].energy_share)
    if count is not None:
        rejected += [(mode, f"not among the {count} of most energy") for mode, _ in modes[count:]]
        modes = modes[:count]
    notes = list(samples.notes)
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
        kind="ambient" if found.decays is None else "free decay",
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


def _samples(logs: Sequence[Log], window) -> _Samples:
    """Records of the logs in a window, and notes on the logs and their faults."""
    records, starts, rates, notes = [], [], [], []
    for log in logs:
        start, stop = _sample_range(log, window)
        if stop - start < MIN_SAMPLES:
            raise ValueError(
                f"{log.source}: {stop - start} samples are too few to identify modes from; "
                f"at least {MIN_SAMPLES} are needed"
            )
        part = log if (start, stop) == (0, log.times.size) else _cut(log, start, stop)
        rate, found, said = even_records(part)
        rates.append(rate)
        records += [record.values for record in found]
        starts += [record.start for record in found]
        faults = (str(fault).removeprefix(f"{log.source}: ") for fault in find_faults(part))
        notes += [*log.notes, *said, *faults]
        if log.names != logs[0].names or abs(rate / rates[0] - 1) > 1e-3:
            raise ValueError(
                f"{log.source}: logs identified together must have the same channels and sampling "
                f"rate; {logs[0].source} has {', '.join(logs[0].names)} at {rates[0]:.6g} Hz, this "
                f"one {', '.join(log.names)} at {rate:.6g} Hz"
            )
    return _Samples(tuple(records), tuple(starts), rates[0], tuple(dict.fromkeys(notes)))


def _cut(log: Log, start: int, stop: int) -> Log:
    """Part of a log."""
    return Log(
        log.times[start:stop], log.values[start:stop], log.names, log.quantities, log.units,
        log.source, valid=log.valid[start:stop],
    )  # fmt: skip


def _with_channels(log: Log, channels: Sequence[str] | None) -> Log:
    """The log with the channels of some names, by default all that are no commands."""
    if channels is None:
        kept = [i for i, actuator in enumerate(log.actuators) if actuator is None]
    else:
        unknown = [name for name in channels if name not in log.names]
        if unknown:
            raise ValueError(
                f"{log.source}: the log has no channel {unknown[0]!r}; it has "
                f"{', '.join(log.names)}"
            )
        kept = [log.names.index(name) for name in channels]
    if kept == list(range(len(log.names))):
        return log

    def pick(entries):
        return tuple(entries[i] for i in kept)

    return Log(
        log.times, log.values[:, kept], pick(log.names), pick(log.quantities), pick(log.units),
        log.source, pick(log.sensors), pick(log.positions), pick(log.actuators), log.loads,
        log.valid[:, kept], log.notes,
    )  # fmt: skip


def _sample_range(log: Log, window) -> tuple[int, int]:
    """First and last (exclusive) sample of a window (s)."""
    if window is None:
        return 0, log.times.size
    step = log.duration / (log.times.size - 1)
    if not (log.times[0] <= window[0] < window[1] <= log.times[-1] + step):
        raise ValueError(
            f"{log.source}: the window from {window[0]:g} s to {window[1]:g} s is not within the "
            f"log, {log.times[0]:.6g} s to {log.times[-1]:.6g} s"
        )
    start, stop = np.searchsorted(log.times, window)
    return int(start), int(stop)


def _check_band(log: Log, rate: float, band) -> None:
    if band is not None and not 0 < band[0] < band[1] <= rate / 2:
        raise ValueError(
            f"{log.source}: the band from {band[0]:g} Hz to {band[1]:g} Hz is not within 0 and "
            f"half the sampling rate, {rate / 2:g} Hz"
        )


def _check_arguments(count, kind, order, method) -> None:
    if count is not None and count < 1:
        raise ValueError(f"count must be at least 1, not {count}")
    if order is not None and order < 4:
        raise ValueError(f"the highest order must be at least 4, not {order}")
    if kind not in (None, *KINDS):
        raise ValueError(f"kind must be {' or '.join(map(repr, KINDS))}, not {kind!r}")
    if method not in (None, *METHODS):
        raise ValueError(f"method must be {' or '.join(map(repr, METHODS))}, not {method!r}")

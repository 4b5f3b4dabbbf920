"""Frequency responses from measured forces: estimates H1, H2 and Hv with their coherence.

p-LSCF where forces were measured: spectra of responses over those of forces, without windows.

Transforms of whole records obey

    a(z) Y_o(z) = sum_i b_oi(z) U_i(z) + t_o(z),   z = exp(i w T),

with polynomials of one degree: a is the common denominator, b / a are the frequency responses, and
t is what the states at the start and the end of a record leave (Pintelon and Schoukens 2012,
section 6.3), so that there is no leakage however lightly the structure is damped. The polynomials
are found by linear least squares over all lines (Guillaume et al. 2003), first unweighted, then
weighted by 1 / |a|, which makes the error that of the outputs (Sanathanan and Koerner 1963). With a
lowest coefficient of one, poles that stand for noise are unstable, and fall away.

A force window keeps the impact and drops the noise of the force sensor after it. An exponential
window exp(-t / T) lets the response fade before the noise prevails, or before the record ends. As
exp(-a t) (h * f) = (exp(-a t) h) * (exp(-a t) f), it multiplies force and response alike and then
adds a = 1 / T to each decay rate, which is subtracted from what is identified: exact for any force
(Fladung and Rost 1997).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from matplotlib.figure import Figure

from jaxbeam.case.fields import refuses_traced
from tuning.logs.log import Log, even_records
from tuning.modal.preprocessing import Samples, part_of_window, samples_of, with_channels

FORCE = "force"


def force_names(logs: Sequence[Log], wanted: Sequence[str] | None) -> tuple[str, ...]:
    """Channels of the measured forces in logs, by default all in N that are no commands.

    A hammer that strikes another place in each log has a name for each: a force that a log lacks
    did not act while it was measured.

    Raises ValueError for a channel that no log has, or that is no force.
    """
    if wanted is None:
        return tuple(dict.fromkeys(name for log in logs for name in _forces_of(log)))
    for name in wanted:
        log = next((one for one in logs if name in one.names), logs[0])
        chosen = with_channels(log, (name,))
        if chosen.quantities[0] != FORCE:
            raise ValueError(
                f"{log.source}: channel {name!r} is in {chosen.units[0]}, which is no force; give "
                f"its unit as N in the heading or by columns, or another channel"
            )
    return tuple(wanted)


def _forces_of(log: Log) -> list[str]:
    """Channels in N that are no commands."""
    return [
        name
        for name, quantity, actuator in zip(log.names, log.quantities, log.actuators, strict=True)
        if quantity == FORCE and actuator is None
    ]


def without_forces(log: Log) -> Log:
    """The log without its channels of force.

    Raises ValueError if no other channel is left.
    """
    kept = [name for name, q in zip(log.names, log.quantities, strict=True) if q != FORCE]
    if not kept:
        raise ValueError(f"{log.source}: the log has forces only, and no response to them")
    return with_channels(log, kept)


def force_records(
    logs: Sequence[Log],
    names: Sequence[str],
    window: tuple[float, float] | None,
    samples: Samples,
) -> tuple[Float[np.ndarray, "time force"], ...]:
    """Forces at the instants of the records of the responses (`samples`), without offset.

    A force that a log lacks is zero in its records.
    """
    found = []
    for log in logs:
        own = [name for name in names if name in log.names]
        # Without a force the instants are those of the responses.
        rate, records, _ = even_records(part_of_window(with_channels(log, own or None), window))
        for record in records:
            values = np.zeros((len(record.values), len(names)))
            if own:
                values[:, [names.index(name) for name in own]] = record.values
            found.append((record.start, values, rate))
    matched = []
    for start, record, (first, values, rate) in zip(
        samples.starts, samples.records, found, strict=True
    ):
        skipped = round((start - first) * rate)
        force = values[skipped : skipped + len(record)]
        matched.append(force - np.median(force, axis=0))
    return tuple(matched)


IMPACT_LEVEL = 0.1  # of the largest force, above which there is an impact
MAX_IMPACT_TIME = 0.05  # fraction of the samples of a log of impacts with an impact
BEFORE = 8  # samples before an impact that belong to it: ringing of an anti-alias filter


class Windows(NamedTuple):
    """Time constant T (s) of the exponential window, duration (s) of the force window, or None."""

    exponential: float | None = None
    force: float | None = None

    @property
    def decay_rate(self) -> float:
        """Decay rate (1/s) that the exponential window adds to that of each mode."""
        return 0.0 if self.exponential is None else 1 / self.exponential


def check_windows(windows: Windows) -> None:
    """Check windows.

    Raises ValueError for a duration that is not above zero.
    """
    for name, value in zip(("exponential", "force"), windows, strict=True):
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"the {name} window must last longer than 0 s, not {value:g} s")


def find_impacts(force: Float[np.ndarray, "time force"]) -> Int[np.ndarray, " impact"]:
    """Samples at which impacts begin, none if the force is no hammer's.

    A hammer's force is above a tenth of its largest value for a twentieth of the time at most.
    """
    size = np.max(np.abs(force) / np.maximum(np.abs(force).max(axis=0), 1e-300), axis=1)
    excited = size > IMPACT_LEVEL
    if not excited.any() or excited.mean() > MAX_IMPACT_TIME:
        return np.zeros(0, int)
    begins = np.flatnonzero(excited & ~np.concatenate([[False], excited[:-1]]))
    # Rebounds and ringing filters cross the level again at once.
    far = np.diff(begins, prepend=-len(force)) > 4 * excited.sum() / begins.size + 2
    return begins[far]


def _impacts_of(force):
    """Samples at which impacts begin. Raises ValueError if there are none."""
    impacts = find_impacts(force)
    if not impacts.size:
        raise ValueError("the measured force has no impacts of a hammer, and windows are for these")
    return impacts


def force_at_impacts(
    force: Float[np.ndarray, "time force"], rate: float, duration: float
) -> Float[np.ndarray, "time force"]:
    """The force for `duration` s from each impact on, and a little before; else zero.

    Raises ValueError if there is no impact.
    """
    kept = np.zeros(len(force), bool)
    for impact in _impacts_of(force).tolist():
        kept[max(impact - BEFORE, 0) : impact + max(int(duration * rate), 1)] = True
    return np.where(kept[:, None], force, 0.0)


def pieces_of_impacts(
    record: Float[np.ndarray, "time output"],
    force: Float[np.ndarray, "time force"],
    rate: float,
    windows: Windows,
) -> list[tuple[Float[np.ndarray, "sample output"], Float[np.ndarray, "sample force"]]]:
    """Response and force from each impact on for the shortest time between impacts, with windows.

    Pieces begin a little before their impact. Raises ValueError if there is no impact.
    """
    impacts = _impacts_of(force)
    if windows.force is not None:
        force = force_at_impacts(force, rate, windows.force)
    length = int(np.diff(np.append(impacts, len(record))).min())
    fade = np.exp(-windows.decay_rate * np.arange(length) / rate)[:, None]
    starts = np.maximum(impacts - BEFORE, 0).tolist()
    return [
        (record[first : first + length] * fade, force[first : first + length] * fade)
        for first in starts
        if first + length <= len(record)
    ]


ESTIMATORS = ("H1", "H2", "Hv")
SEGMENTS = 8  # into which records of a random force are divided if nothing is said
MIN_SEGMENT = 16  # samples


@dataclass(frozen=True, eq=False)
class MeasuredResponses:
    """Frequency responses of the channels of a log to the forces measured in it.

    `values` are complex, in SI units of each channel per N; `coherence` is that of each output with
    all forces together, NaN for a single average, which has none; `averages` is the number of
    segments or impacts. `decay_rate` (1/s) is that of the exponential window, added to that of each
    mode.

    >>> import numpy as np
    >>> import tuning
    >>> force = np.random.default_rng(0).normal(size=4000)
    >>> columns = ("f", "v1"), ("force", "velocity"), ("N", "m/s")
    >>> log = tuning.Log(
    ...     0.001 * np.arange(4000), np.column_stack([force, 2e-3 * force]), *columns
    ... )
    >>> found = tuning.modal.measured_responses(log)
    >>> print(f"{abs(found.values).mean():.1e} m/s/N, coherence {found.coherence.mean():.2f}")
    2.0e-03 m/s/N, coherence 1.00
    """

    frequencies: Float[np.ndarray, " frequency"]
    values: Complex[np.ndarray, "frequency output force"]
    coherence: Float[np.ndarray, "frequency output"]
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    forces: tuple[str, ...]
    estimator: str
    averages: int
    decay_rate: float = 0.0
    source: str = "log"

    @property
    def deviations(self) -> Float[np.ndarray, "frequency output"]:
        """Relative standard deviations of the values, sqrt((1 - g^2) / (2 n g^2)).

        (Bendat and Piersol 2010, Random Data, section 9.1.)
        """
        coherence = np.clip(self.coherence, 1e-12, 1.0)
        return np.sqrt((1 - coherence) / (2 * self.averages * coherence))

    def true_damping_ratio(self, frequency: float, damping_ratio: float) -> float:
        """Damping ratio of a mode corrected for the exponential window: z - a / w.

        `frequency` is the natural frequency (Hz).
        """
        return damping_ratio - self.decay_rate / (2 * np.pi * frequency)

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw magnitude, phase and coherence of all outputs; saved if a path is given."""
        from tuning.modal.plot import plot_responses

        return plot_responses(self, path)


@refuses_traced("a measured response")
def measured_responses(
    log: Log | Sequence[Log],
    force: Sequence[str] | None = None,
    *,
    estimator: str = "H1",
    channels: Sequence[str] | None = None,
    window: tuple[float, float] | None = None,
    segment: float | None = None,
    exponential: float | None = None,
    force_window: float | None = None,
) -> MeasuredResponses:
    """Frequency responses to the measured forces `force` (names; all in N if left out).

    With spectra S averaged over segments, H1 = S_yf S_ff^-1 is free of the bias of noise in the
    responses, H2 = S_yy / S_fy of that of noise in the force, Hv = sqrt(S_yy / S_ff) with the phase
    of H1 divides it between both (Rocklin, Crowley and Vold 1985); the last two are for one force.
    Of a hammer a segment is the time from one impact to the next, all as long as the shortest; else
    segments of `segment` s (an eighth of the log) have a window of Hann and overlap by half.
    `exponential` (s) is the time constant of a window on impacts and responses, `force_window` (s)
    the time after which the force is taken for zero. `window` (s) is the part of the log used.

    Raises ValueError for an unknown estimator, an H2 or Hv of several forces, windows without
    impacts, no force, fewer segments than forces, and what `identify_modes` raises for its logs.

    >>> import numpy as np
    >>> import tuning
    >>> force = np.random.default_rng(0).normal(size=1000)
    >>> columns = ("f", "v1"), ("force", "velocity"), ("N", "m/s")
    >>> log = tuning.Log(0.01 * np.arange(1000), np.stack([force, 3.0 * force], axis=1), *columns)
    >>> found = tuning.modal.measured_responses(log, estimator="H2", segment=1.0)
    >>> print(found.frequencies[:3].round(2), f"{abs(found.values).mean():.2f} m/s/N")
    [1. 2. 3.] 3.00 m/s/N
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator must be {', '.join(ESTIMATORS)}, not {estimator!r}")
    windows = Windows(exponential, force_window)
    check_windows(windows)
    logs = [log] if isinstance(log, Log) else list(log)
    names = force_names(logs, force)
    if not names:
        raise ValueError(f"{logs[0].source}: no channel is a force in N; name it by force")
    if estimator != "H1" and len(names) > 1:
        raise ValueError(f"{estimator} is for one force, not {len(names)}; use H1")
    measured = [without_forces(with_channels(one, channels)) for one in logs]
    samples = samples_of(measured, window)
    driving = force_records(logs, names, window, samples)
    records = [record - np.median(record, axis=0) for record in samples.records]
    hammer = all(find_impacts(one).size for one in driving)
    if hammer and segment is None:
        pieces = [
            piece
            for record, own in zip(records, driving, strict=True)
            for piece in pieces_of_impacts(record, own, samples.rate, windows)
        ]
        taper = None
    elif windows != Windows():
        raise ValueError(
            f"{logs[0].source}: windows are for impacts of a hammer; leave out exponential and "
            f"force_window with {'a segment' if hammer else 'a steady force'}"
        )
    else:
        pieces = _segments(records, driving, samples.rate, segment)
        taper = np.hanning(len(pieces[0][0]) + 1)[:-1, None]
    size = min(len(piece[0]) for piece in pieces)
    if len(pieces) < len(names):
        raise ValueError(
            f"{logs[0].source}: {len(pieces)} segments do not separate {len(names)} forces"
        )
    values, coherence = _estimate(pieces, size, taper, estimator)
    bins = np.fft.rfftfreq(size, 1 / samples.rate)
    return MeasuredResponses(
        bins[1:], values[1:], coherence[1:], measured[0].names, measured[0].units, names,
        estimator, len(pieces), windows.decay_rate, logs[0].source,
    )  # fmt: skip


def _segments(records, driving, rate, segment):
    """Pieces of all records, half their length apart."""
    longest = max(map(len, records))
    size = longest // SEGMENTS if segment is None else int(segment * rate)
    if not MIN_SEGMENT <= size <= longest:
        raise ValueError(
            f"a segment of {size} samples is not within {MIN_SEGMENT} and the {longest} of a record"
        )
    return [
        (record[first : first + size], force[first : first + size])
        for record, force in zip(records, driving, strict=True)
        for first in range(0, len(record) - size + 1, max(size // 2, 1))
    ]


def _estimate(pieces, size, taper, estimator):
    """Responses (line, output, force) and coherence (line, output) of averaged spectra."""
    outputs, forces = [], []
    for record, force in pieces:
        if taper is not None:
            record, force = record - record.mean(axis=0), force - force.mean(axis=0)
        both = [one[:size] if taper is None else one * taper for one in (record, force)]
        outputs.append(np.fft.rfft(both[0], axis=0))
        forces.append(np.fft.rfft(both[1], axis=0))
    y, f = np.stack(outputs, axis=1), np.stack(forces, axis=1)  # line, average, channel
    across = np.einsum("lno,lni->loi", y, f.conj())
    among = np.einsum("lni,lnj->lij", f, f.conj())
    power = np.maximum(np.sum(np.abs(y) ** 2, axis=1), 1e-300)
    first = across @ np.linalg.pinv(among, hermitian=True)
    explained = np.einsum("loi,loi->lo", first, across.conj()).real
    coherence = np.clip(explained / power, 0.0, 1.0)
    if len(pieces) <= f.shape[2]:
        coherence = np.full_like(coherence, np.nan)
    if estimator == "H2":
        reverse = across.conj()
        return power[:, :, None] / np.where(np.abs(reverse) > 0, reverse, np.inf), coherence
    if estimator == "Hv":
        size = np.sqrt(power[:, :, None] / np.maximum(among.real, 1e-300))
        return size * np.exp(1j * np.angle(first)), coherence
    return first, coherence


HIGHEST_LINE = 1.15  # of transforms, over the upper end of a band
MAX_ANGLE = 2.8  # of z on the circle, of a band from 0
PART_LINES = 4096  # lines whose products are formed at once
# Least product of driving signals, over the largest: a thousandth of the signals, less than noise.
# Early impacts are nearly powers of z; a shape would be a difference of large gains of them and of
# the transient, whatever their sum fits.
MIN_DRIVING = 1e-6


class Lines(NamedTuple):
    """Lines of the transforms of all records: spectra (line, output), (line, input), z and record.

    `step` is the sampling step (s); `level`, if any, is what spectra of each line were multiplied
    by, so that errors of all lines have one variance.
    """

    outputs: Complex[np.ndarray, "line output"]
    inputs: Complex[np.ndarray, "line input"]
    z: Complex[np.ndarray, " line"]
    record: Int[np.ndarray, " line"]
    step: float
    level: Float[np.ndarray, " line"] | None = None

    @property
    def spacing(self) -> float:
        """Typical distance (1/s) of neighbouring lines."""
        return float(np.median(np.abs(np.diff(np.angle(self.z)))) / self.step)

    @property
    def unforced(self) -> Float[np.ndarray, "line record"]:
        """Columns of one at the lines of each record, for its transient."""
        own = (self.record[:, None] == np.arange(self.record.max() + 1)).astype(float)
        return own if self.level is None else own * self.level[:, None]

    def part(self, lines: Bool[np.ndarray, " line"]) -> "Lines":
        """Some of the lines."""
        level = None if self.level is None else self.level[lines]
        return Lines(
            self.outputs[lines], self.inputs[lines], self.z[lines], self.record[lines], self.step,
            level,
        )  # fmt: skip


class Products(NamedTuple):
    """Products (signal, power, signal, power) of z^j and z^m times signals, summed over lines.

    Signals are outputs, inputs, and one for each record, of the `lines`.
    """

    gram: Float[np.ndarray, "signal power signal power"]
    outputs: int
    lines: Lines


class CommonDenominator(NamedTuple):
    """Denominator a, lowest power first; poles (1/s) in the upper half plane; unit shapes."""

    denominator: Float[np.ndarray, " power"]
    poles: Complex[np.ndarray, " pole"]
    shapes: Complex[np.ndarray, "pole output"]


def transforms(
    records: tuple[Float[np.ndarray, "_ output"], ...],
    forces: tuple[Float[np.ndarray, "_ input"], ...],
    rate: float,
    band: tuple[float, float],
) -> Lines:
    """Discrete Fourier transforms of records and forces at the lines of a band (Hz).

    These are of whole records as sampled. The step of z is stretched, so that the band fills most
    of the circle, which powers of z need.
    """
    step = max(MAX_ANGLE / (2 * np.pi * band[1]), 1 / rate)
    outputs, inputs, z, numbers = [], [], [], []
    for number, (record, force) in enumerate(zip(records, forces, strict=True)):
        bins = np.fft.rfftfreq(len(record), 1 / rate)
        lines = (bins >= band[0]) & (bins <= band[1])
        scale = 1 / np.sqrt(len(record))
        outputs.append(scale * np.fft.rfft(record, axis=0)[lines])
        inputs.append(scale * np.fft.rfft(force, axis=0)[lines])
        z.append(np.exp(2j * np.pi * bins[lines] * step))
        numbers.append(np.full(lines.sum(), number))
    return Lines(
        np.concatenate(outputs), np.concatenate(inputs), np.concatenate(z),
        np.concatenate(numbers), step,
    )  # fmt: skip


def products(
    lines: Lines, degree: int, weights: Float[np.ndarray, " line"] | None = None
) -> Products:
    """Products for all degrees to the highest, by default with equal weights of the lines."""
    signals = np.concatenate([lines.outputs, lines.inputs, lines.unforced], axis=1)
    if weights is not None:
        signals = signals * weights[:, None]
    count = signals.shape[1]
    sums = np.zeros((count * count, 2 * degree + 1))
    for first in range(0, len(signals), PART_LINES):
        own, z = signals[first : first + PART_LINES], lines.z[first : first + PART_LINES]
        pairs = (own.conj()[:, :, None] * own[:, None, :]).reshape(len(own), -1)
        powers = z[:, None] ** np.arange(-degree, degree + 1)
        sums += pairs.real.T @ powers.real - pairs.imag.T @ powers.imag
    # Products depend on the difference of the powers only.
    shift = np.arange(degree + 1) - np.arange(degree + 1)[:, None] + degree
    gram = sums.reshape(count, count, -1)[:, :, shift].transpose(0, 2, 1, 3)
    return Products(gram, lines.outputs.shape[1], lines)


def fit_common_denominator(system: Products, degree: int) -> CommonDenominator:
    """Polynomials of a degree, at most that of the products.

    A shape is the response of all numerators at a root to the signals at the line nearest to it.
    How much of it is forced and how much free, which one impact leaves open, does not matter.
    """
    size, outputs = degree + 1, system.outputs
    part = system.gram[:, :size, :, :size]
    driving = part[outputs:, :, outputs:].reshape(-1, (part.shape[0] - outputs) * size)
    crossed = part[outputs:, :, :outputs].reshape(len(driving), -1)
    gains = np.linalg.lstsq(driving, crossed, rcond=MIN_DRIVING)[0]
    crossed, gains = (one.reshape(len(driving), outputs, size) for one in (crossed, gains))
    matrix = np.einsum("ojok->jk", part[:outputs, :, :outputs])
    matrix = matrix - np.tensordot(crossed, gains, axes=((0, 1), (0, 1)))
    free = np.linalg.lstsq(matrix[1:, 1:], -matrix[1:, 0], rcond=1e-15)[0]
    denominator = np.concatenate([[1.0], free])
    roots = np.roots(denominator[::-1])
    roots = roots[(roots.imag > 0) & (np.abs(roots) < 1e6)]
    numerators = (gains @ denominator).reshape(-1, size, outputs)
    at_roots = roots[:, None] ** np.arange(size)
    responses = np.einsum(
        "rp,xpo,rkx->rok", at_roots, numerators, _signals_at(system.lines, roots), optimize=True
    )
    shapes = np.linalg.svd(responses)[0][:, :, 0]
    return CommonDenominator(denominator, np.log(roots) / system.lines.step, shapes)


def _signals_at(lines: Lines, roots):
    """Inputs and unforced terms (root, record, signal) at the lines nearest to roots."""
    signals = np.concatenate([lines.inputs, lines.unforced], axis=1)
    found = []
    for record in range(int(lines.record.max()) + 1):
        own = np.flatnonzero(lines.record == record)
        distance = np.abs(np.angle(lines.z[own])[:, None] - np.angle(roots))
        found.append(signals[own[np.argmin(distance, axis=0)]])
    return np.stack(found, axis=1)

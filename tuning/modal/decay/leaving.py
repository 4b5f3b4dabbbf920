"""When the excitation of a log ends: a load that shook the structure has left it.

While a rough load crosses, no sample stands out as that of a blow does, but past samples predict
the coming ones worse than they do afterwards. The variance of prediction errors is that of the
noise, and a share of the energy E of the vibration, which a model that is not quite right leaves;
until an instant that of the forces may be added,

    v(t) = a + b E(t) + c 1(t < t_0),   a, b, c >= 0,

if the likelihood of the errors' mean squares, block by block, gains by it more than by chance, and
more than by a decay c exp(-t / T) in its place, which modes have that decay faster than most.

A load that excites little while it leaves shows in the fit: decaying modes leave the noise alone,
which is the same throughout, but more where forces act; or the fit explains these, too, by several
modes where there is one, or by vibrations that grow.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from tuning.modal.ambient import Candidate
from tuning.modal.decay.stretches import Stretch
from tuning.modal.result import mac_matrix

MIN_GAIN = 12.0  # of the logarithm of the likelihood: of all instants tried, one in ten thousand
LATEST_LOSS = 2.0  # of the same, within which the latest instant is taken
MIN_BLOCKS = 10  # before an instant and after it
MIN_RAISED = 2 / 3  # of the blocks before it, in which errors are more than after it
MAX_TRIED = 60  # instants
ITERATIONS = 8  # of the least squares of variances
DECAY_TIMES = 2.0 ** -np.arange(7)  # T, over the duration
MAX_PARTS = 4  # that are searched one after another, as a load may shake less towards its end
PARTS = 10  # of a decay, whose errors are compared
MIN_RATIO, RATIO_SDS = 2.5, 5.0  # of errors of a part to the median; or deviations of the ratio
SPLIT_RATIO, SPLIT_MAC = 1.1, 0.9  # of three frequencies, and of the shapes of modes of one
SPLIT_POLES = 4  # within the same ratio
MIN_GROWTH = 0.2  # nepers of a vibration over the decay
MIN_GROWING_SHARE = 0.01  # of the energy
MIN_UNEXPLAINED = 0.05  # of the energy of a part, and of the mean; less may be nonlinearity


def without_excitation(
    decays: tuple[Stretch, ...],
    measured: Float[np.ndarray, "sample column"],
    fitted: Float[np.ndarray, "sample column"],
    candidates: tuple[Candidate, ...],
    *,
    channels: int,
    rate: float,
    independent: float,
    after_blow: bool,
) -> tuple[Stretch, ...]:
    """Those of several fitted decays that are undisturbed, or the part of one; all if nothing is.

    Columns are the `channels` of each decay, at a `rate` (Hz). `candidates` are the modes of the
    fit, `independent` is the share of samples that are, in its band; `after_blow` says that nothing
    acts from the beginning.
    """
    first, *others = decays
    split = has_split(candidates)
    if others:
        grows = growing_share(candidates, len(measured) / rate) > MIN_GROWING_SHARE
        least = 0.0 if grows or split else MIN_UNEXPLAINED
        return undisturbed(decays, measured, fitted, channels, least)
    shaken = shaken_until(measured, fitted, independent)
    if not shaken and not after_blow and split:
        shaken = len(measured) // PARTS
    return (first._replace(start=first.start + shaken),)


def growing_share(candidates: tuple[Candidate, ...], duration: float) -> float:
    """Largest share in the energy of a fit, of some `duration` (s), of a vibration that grows.

    Forces make vibrations grow; steady hum does not. Of 100 decays without forces (60 s, planted
    structures) none has one of more than a hundredth.
    """
    growing = [
        one.mode.energy_share
        for one in candidates
        if 2 * np.pi * one.mode.frequency * -one.mode.damping_ratio * duration > MIN_GROWTH
    ]
    return max(growing, default=0.0)


def has_split(candidates: tuple[Candidate, ...]) -> bool:
    """Whether the fit makes several modes of one, as where forces act.

    Three modes are then close and alike, or four poles are close, whether modes or not, or three in
    two places: of 100 decays without forces of planted structures, with pairs of modes, one has
    three such poles.
    """
    crowds = _crowds(sorted(one.mode.frequency for one in candidates))
    if max(crowds, default=0) >= SPLIT_POLES or sum(n >= SPLIT_POLES - 1 for n in crowds) > 1:
        return True
    modes = [one.mode for one in candidates if not one.reason]
    modes.sort(key=lambda mode: mode.frequency)
    for first, second, third in zip(modes, modes[1:], modes[2:], strict=False):
        if third.frequency < SPLIT_RATIO * first.frequency:
            shapes = np.stack([first.shape, second.shape, third.shape])
            if mac_matrix(shapes, shapes).min() > SPLIT_MAC:
                return True
    return False


def _crowds(frequencies: list[float]) -> list[int]:
    """Numbers of poles that are close, in places apart; the largest first of those that overlap."""
    left, numbers = np.array(frequencies), []
    while left.size:
        inside = (left >= left[:, None]) & (left < SPLIT_RATIO * left[:, None])
        most = int(np.argmax(inside.sum(axis=1)))
        numbers.append(int(inside[most].sum()))
        left = left[~inside[most]]
    return numbers


def shaken_until(
    measured: Float[np.ndarray, "sample channel"],
    fitted: Float[np.ndarray, "sample channel"],
    independent: float,
) -> int:
    """Sample of a fitted decay up to which errors are more than elsewhere; 0 if they are not.

    They must be more than the noise, and than their share of the energy, of what comes after.
    `independent` is the share of samples that are, in the band of the fit.
    """
    scale = np.maximum(np.mean(measured**2, axis=0), 1e-300)
    errors, energy = (
        np.array([np.mean(part) for part in np.array_split(squares / scale, PARTS)])
        for squares in ((measured - fitted) ** 2, measured**2)
    )
    freedom = max(independent * measured.size / PARTS, 1.0)
    ratio = max(MIN_RATIO, 1 + RATIO_SDS * np.sqrt(2 / freedom))
    # What is little of the whole decay tells little of it, and may be chance.
    least = MIN_UNEXPLAINED * np.maximum(energy, energy.mean())
    more = (errors > ratio * np.median(errors)) & (errors > least)
    last = _last(more)
    # Errors in proportion to the energy, before as after, are those of a nonlinear structure.
    noise = np.median(errors[last:]) if last < PARTS else 0.0
    share = max(np.sum(errors[last:] - noise) / max(np.sum(energy[last:]), 1e-300), 0.0)
    more &= errors > ratio * (noise + share * energy)
    return len(measured) * _last(more) // PARTS


def _last(more) -> int:
    """Number of parts to the last of some."""
    return int(np.max(np.flatnonzero(more) + 1, initial=0))


def undisturbed(
    decays: tuple[Stretch, ...],
    measured: Float[np.ndarray, "sample column"],
    fitted: Float[np.ndarray, "sample column"],
    channels: int,
    least: float = MIN_UNEXPLAINED,
) -> tuple[Stretch, ...]:
    """Those of several fitted decays that have no more errors than others.

    Noise is the same in all, however hard the blows were; errors of less than a share `least` of
    the energy may be nonlinearity. Columns are the channels of each decay; if they are combinations
    of decays, all are returned.
    """
    if measured.shape[1] != len(decays) * channels:
        return decays
    errors, energy = (
        np.sum(squares, axis=0).reshape(len(decays), -1).sum(axis=1)
        for squares in ((measured - fitted) ** 2, measured**2)
    )
    more = (errors > MIN_RATIO * errors.min()) & (errors > least * energy)
    return tuple(one for one, has in zip(decays, more, strict=True) if not has)


def end_of_excitation(
    errors: Float[np.ndarray, "sample channel"],
    record: Float[np.ndarray, "sample channel"],
    struck: Bool[np.ndarray, " sample"],
    size: int,
) -> int:
    """Sample from which on errors of prediction are those of a free structure; 0 if none is.

    Blocks have `size` samples; those with `struck` samples, of blows, do not count.
    """
    scale = np.maximum(np.mean(errors**2, axis=0), 1e-300)
    level = np.maximum(np.mean(record**2, axis=0), 1e-300)
    squares, energy = _blocks(errors**2 / scale, size), _blocks(record**2 / level, size)
    marks = struck[: size * len(squares)].reshape(-1, size).any(axis=1)
    kept = np.flatnonzero(~(marks | np.roll(marks, 1)))
    freedom, first = size * errors.shape[1], 0
    for _ in range(MAX_PARTS):
        found = _step(squares[kept[first:]], energy[kept[first:]], freedom)
        if not found:
            break
        first += found
    return size * (int(kept[min(first, kept.size - 1)]) + 1) if first else 0


def _blocks(values, size):
    """Means over channels and blocks of samples."""
    count = len(values) // size
    return values[: count * size].mean(axis=1).reshape(count, size).mean(axis=1)


def _step(squares, energy, freedom) -> int:
    """Blocks before the latest instant at which the errors may have fallen; 0 if they did not."""
    count = len(squares)
    tried = np.arange(MIN_BLOCKS, count - MIN_BLOCKS, max(count // MAX_TRIED, 1))
    if not tried.size or not energy.any():
        return 0
    steady, places = np.stack([np.ones(count), energy], axis=1), np.arange(count)
    least = min(
        _fit(squares, np.column_stack([steady, np.exp(-places / (share * count))]))[0]
        for share in DECAY_TIMES
    )

    def gains_at(instants):
        gains = []
        for instant in instants.tolist():
            cost, variance = _fit(squares, np.column_stack([steady, places < instant]))
            raised = np.mean(squares[:instant] > variance[:instant]) > MIN_RAISED
            gains.append((least - cost) * freedom / 2 if raised else 0.0)
        return np.array(gains)

    gains = gains_at(tried)
    if gains.max() < MIN_GAIN:
        return 0
    reach = max(count // MAX_TRIED, 1)
    best = int(tried[np.argmax(gains)])
    tried = np.arange(max(best - reach, MIN_BLOCKS), min(best + reach, count - MIN_BLOCKS) + 1)
    gains = gains_at(tried)
    return int(tried[np.flatnonzero(gains > gains.max() - LATEST_LOSS)[-1]])


def _fit(squares, columns):
    """Least cost of mean squares, and their variances but for the last of three columns."""
    variance = np.full(len(squares), squares.mean())
    found = np.zeros(columns.shape[1])
    for _ in range(ITERATIONS):
        found = nnls(columns / variance[:, None], squares / variance)[0]
        variance = np.maximum(columns @ found, 1e-3 * squares.mean())
    return float(np.sum(np.log(variance) + squares / variance)), columns[:, :2] @ found[:2]

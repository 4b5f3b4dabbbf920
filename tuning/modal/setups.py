"""Modes merged from several setups: sensors that move between records, and references that stay.

    fit = merge_setups([identify_modes(read_log(path)) for path in ("north.csv", "south.csv")])

Modes of the setups are paired, their frequencies and damping ratios averaged with the inverse
variances as weights, and their shapes scaled to each other at the references (PoSER: Reynders,
Magalhaes, De Roeck and Cunha 2009; here for all setups at once). Where setups disagree by more than
their errors, these are widened by the ratio of both (Birge 1932).

Channels say which places of the structure several setups have in common, and which logs are of one
setup. What a setup measures is c_s Phi at its channels, Phi the shape and c_s a complex scale.
Shape and scales that fit all parts best, each weighted by its variance, are found by Gauss-Newton
steps; that is post-separate-estimation re-scaling (PoSER; Reynders, Magalhaes, De Roeck and Cunha
2009), with all references of all setups at once. Errors of the parts are propagated to first order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Complex, Float, Int
from scipy.stats import chi2

from jaxbeam.case.fields import refuses_traced
from tuning.logs.log import Log, even_records
from tuning.modal.forced.measured_responses import without_forces
from tuning.modal.identify_modes import Choice, ModalFit
from tuning.modal.preprocessing import MAX_RATE_CHANGE, same_channels, with_channels
from tuning.modal.result import (
    MIN_ENERGY,
    Channels,
    IdentifiedMode,
    ModalEstimates,
    channels_of,
    mac_matrix,
)

STEPS = 12  # of Gauss and Newton, at most
MIN_VARIANCE = 1e-8  # of a component over the largest, for weights
OTHER_ERROR = 0.02  # of a component over the largest: calibration, added to its stated error
MIN_SIGNAL = 3.0  # size of a shape at the references over its error


class Part(NamedTuple):
    """A shape at some channels; `covariance` is that of its real parts, then imaginary parts."""

    shape: Complex[np.ndarray, " own"]
    covariance: Float[np.ndarray, "part part"]
    channels: Int[np.ndarray, " own"]

    @property
    def variances(self) -> Float[np.ndarray, " own"]:
        """Variance of each component: of its real and imaginary part together."""
        diagonal = np.diag(self.covariance)
        return diagonal[: self.shape.size] + diagonal[self.shape.size :]


class WholeShape(NamedTuple):
    """Shape with a largest component of one, NaN at channels without, and its covariance.

    `joined` are the parts that it is made of; `misfit` is the rms difference of the parts at common
    channels over that expected from their errors, which are widened by it beyond one.
    """

    shape: Complex[np.ndarray, " channel"]
    covariance: Float[np.ndarray, "part part"]
    joined: tuple[int, ...]
    misfit: float


def whole_shape(parts: Sequence[Part], count: int) -> WholeShape:
    """Whole shape at `count` channels, joined from its parts.

    A part whose common channels with the others are all near a node of the mode, or that has none,
    cannot be scaled and is left out.
    """
    start, scales = _joined(parts, count)
    used = tuple(sorted(scales))
    present = np.flatnonzero(np.isfinite(start))
    largest = int(present[np.argmax(np.abs(start[present]))])
    free = np.array([i for i in present if i != largest], int)
    shape = start / start[largest]
    scale = np.array([scales[k] for k in used]) * start[largest]
    own = [parts[k] for k in used]
    measured = np.concatenate([part.shape for part in own])
    which = np.concatenate([part.channels for part in own])
    by = np.repeat(np.arange(len(own)), [part.shape.size for part in own])
    weights = np.sqrt([1 / (part.variances.mean() + MIN_VARIANCE) for part in own])[by]
    rows = np.arange(measured.size)
    column = np.full(count, -1)
    column[free] = np.arange(free.size)
    moving = which != largest
    for _ in range(STEPS):
        slopes = np.zeros((measured.size, free.size + len(own)), complex)
        slopes[rows[moving], column[which[moving]]] = scale[by[moving]]
        slopes[rows, free.size + by] = shape[which]
        inverse = np.linalg.pinv(weights[:, None] * slopes) * weights
        step = inverse @ (measured - scale[by] * shape[which])
        shape[free] += step[: free.size]
        scale = scale + step[free.size :]
    covariance = _block_diagonal([part.covariance for part in own])
    rest = measured - scale[by] * shape[which]
    left = _real(weights[:, None] * (np.eye(measured.size) - slopes @ inverse))
    expected = np.trace(left @ covariance @ left.T)
    disagreement = float(np.sum(np.abs(weights * rest) ** 2))
    misfit = float(np.sqrt(disagreement / expected)) if expected > 0 else 0.0
    forward = _real(inverse[: free.size])
    errors = forward @ covariance @ forward.T * max(misfit, 1.0) ** 2
    all_errors = np.full((2 * count, 2 * count), np.nan)
    both = np.concatenate([present, count + present])
    all_errors[np.ix_(both, both)] = 0.0
    both = np.concatenate([free, count + free])
    all_errors[np.ix_(both, both)] = errors
    return WholeShape(shape, all_errors, used, misfit)


def _joined(parts: Sequence[Part], count: int):
    """A first shape, NaN where there is none, and the scales of the parts that it is made of."""
    first = max(range(len(parts)), key=lambda k: parts[k].shape.size)
    shape, variances = np.full(count, np.nan, complex), np.zeros(count)
    shape[parts[first].channels] = parts[first].shape
    variances[parts[first].channels] = parts[first].variances
    scales = {first: 1.0 + 0j}
    while True:
        signals = {
            k: _signal(part, shape, variances) for k, part in enumerate(parts) if k not in scales
        }
        best = max(signals, key=lambda k: signals[k], default=None)
        if best is None or signals[best] < MIN_SIGNAL:
            return shape, scales
        part = parts[best]
        common = np.isfinite(shape[part.channels])
        old = shape[part.channels[common]]
        scales[best] = np.vdot(old, part.shape[common]) / np.vdot(old, old).real
        new = part.channels[~common]
        shape[new] = part.shape[~common] / scales[best]
        variances[new] = part.variances[~common] / abs(scales[best]) ** 2


def _signal(part: Part, shape, variances) -> float:
    """Signal-to-error ratio of a part and of a shape at their common channels, the smaller one."""
    common = np.isfinite(shape[part.channels])
    if not common.any():
        return 0.0
    places = part.channels[common]
    pairs = (
        (np.abs(part.shape), part.shape[common], part.variances[common]),
        (np.abs(shape[np.isfinite(shape)]), shape[places], variances[places]),
    )
    return min(
        float(np.sqrt(np.sum(np.abs(one) ** 2) / np.sum(own + (OTHER_ERROR * whole.max()) ** 2)))
        for whole, one, own in pairs
    )


def _block_diagonal(covariances: Sequence[np.ndarray]) -> np.ndarray:
    """Covariance of all real parts, then all imaginary parts, of independent shapes."""
    sizes = [len(one) // 2 for one in covariances]
    total, start = sum(sizes), 0
    found = np.zeros((2 * total, 2 * total))
    for one, size in zip(covariances, sizes, strict=True):
        own = np.arange(start, start + size)
        both = np.concatenate([own, total + own])
        found[np.ix_(both, both)] = one
        start += size
    return found


def _real(matrix: np.ndarray) -> np.ndarray:
    """Real matrix on real, then imaginary parts that is equivalent to a complex one."""
    return np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]])


def merged_channels(
    setups: Sequence[Channels], sources: Sequence[str], references: Sequence[str] | None
) -> tuple[Channels, tuple[Int[np.ndarray, " channel"], ...]]:
    """Channels of all setups, each place once, and where those of each setup are among them.

    Channels of one name and quantity are one place, unless their positions (or sensors of the case)
    in the logs differ. With `references`, the channels of these names are, and no others.
    `sources` are the names of the logs, for messages.

    Raises ValueError for a reference that a setup lacks, and for setups that no common channel
    connects with the others.
    """
    for setup, source in zip(setups, sources, strict=True):
        lacking = set(references or ()) - set(setup.names)
        if lacking:
            raise ValueError(
                f"{source}: no channel {sorted(lacking)[0]!r}, which is to be a reference; "
                f"the channels are {', '.join(setup.names)}"
            )
    given = _given_places(setups)
    places: dict[tuple, int] = {}
    rows, indices = [], []
    for number, setup in enumerate(setups):
        of_setup = []
        for row in zip(*setup, strict=True):
            name, quantity, position, sensor = row
            key: tuple = (name, quantity)
            if references is not None:
                key = key if name in references else (*key, number)
            elif len(given[name]) > 1:
                unknown = position is None and sensor is None
                key = (*key, number) if unknown else (*key, position, sensor)
            if key not in places:
                places[key] = len(rows)
                rows.append((row, sources[number]))
            of_setup.append(places[key])
        indices.append(np.array(of_setup))
    _check_connected(setups, sources, indices)
    names = [row[0] for row, _ in rows]
    named = tuple(
        row[0] if names.count(row[0]) == 1 else _full_name(row, source) for row, source in rows
    )
    _, quantities, positions, sensors = zip(*(row for row, _ in rows), strict=True)
    return Channels(named, quantities, positions, sensors), tuple(indices)


def _given_places(setups: Sequence[Channels]) -> dict[str, set]:
    """Positions and sensors in the logs, by the name of the channel."""
    places: dict[str, set] = {}
    for setup in setups:
        for name, _, position, sensor in zip(*setup, strict=True):
            of_name = places.setdefault(name, set())
            if position is not None or sensor is not None:
                of_name.add((position, sensor))
    return places


def _full_name(row: tuple, source: str) -> str:
    """Name of a channel that moves: with its position if that is given, else with its log."""
    name, _, position, _ = row
    return f"{name} at {position:g} m" if position is not None else f"{name} of {Path(source).stem}"


def _check_connected(setups: Sequence[Channels], sources: Sequence[str], indices) -> None:
    """Check that common channels lead from the first setup to all others."""
    joined, reached = {0}, set(indices[0].tolist())
    while more := [k for k in range(len(setups)) if k not in joined and reached & {*indices[k]}]:
        joined |= set(more)
        reached |= {int(i) for k in more for i in indices[k]}
    left = [k for k in range(len(setups)) if k not in joined]
    if left:
        raise ValueError(
            f"{sources[left[0]]}: no channel is common with {sources[0]}, by which their shapes "
            f"could be scaled (the channels are {', '.join(setups[left[0]].names)}; and "
            f"{', '.join(setups[0].names)}); references have the same name, quantity and position "
            "in both"
        )


def logs_of_setups(
    logs: Sequence[Log],
    references: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
) -> list[list[Log]]:
    """The logs of each setup: those with the same channels, positions and sampling rate.

    With `references`, channels of one name may be at different places in each log, and each is a
    setup of its own. Measured forces do not count: a hammer may strike many places.
    `channels` are the names of those that are to be used, by default all.

    Raises ValueError for references with one log only, or that a log lacks, for setups without
    a common channel, a log with forces only, and samples that are not even.
    """
    if references is not None and len(logs) == 1:
        raise ValueError(
            f"{logs[0].source}: references connect several setups, and this is one log"
        )
    groups: list[list[Log]] = []
    for log in logs:
        own = next((group for group in groups if _same_setup(group[0], log)), None)
        if own is None or references is not None:
            groups.append([log])
        else:
            own.append(log)
    if len(groups) > 1:
        used = [_with_known(without_forces(group[0]), channels) for group in groups]
        merged_channels(
            [channels_of(log) for log in used], [log.source for log in used], references
        )
    return groups


def _with_known(log: Log, names: Sequence[str] | None) -> Log:
    """The log with those channels of `names` that it has; with all of its own if that is None."""
    return with_channels(log, [name for name in names or () if name in log.names] or None)


def _same_setup(a: Log, b: Log) -> bool:
    """Whether the channels but for forces, and the sampling rates, of two logs are the same."""
    if not same_channels(without_forces(a), without_forces(b)):
        return False
    rate, other = (even_records(log)[0] for log in (a, b))
    return abs(rate / other - 1) < MAX_RATE_CHANGE


MAX_FREQUENCY_CHANGE = 0.03  # between setups: temperature, traffic, the mass of moved sensors
MAX_SDS = 3.0  # standard deviations of the difference of two frequencies that may be more
MIN_MAC = 0.6  # at common channels, for shapes without errors
NEAR_MODE_ERROR = (
    0.05  # of a component over the largest, by modes close by, added to its stated error
)
MIN_ENERGY_ALONE = 0.05  # fraction of the energy below which a mode of one setup may be noise
FAR = 1e6  # distance of modes that cannot be one


def paired_modes(setups: Sequence[ModalFit], indices: Sequence[np.ndarray]) -> list[dict[int, int]]:
    """Groups of modes that are one mode of the structure: index of the mode by index of the setup.

    Modes of a setup are paired with those of the setups before by the least sum of distances, in
    frequency and in modal assurance criterion at the channels that both setups have, where these
    are two or more. `indices` say which of all channels those of each setup are.
    """
    groups: list[dict[int, int]] = []
    for number, setup in enumerate(setups):
        cost = np.full((len(groups), len(setup.modes)), FAR)
        for row, group in enumerate(groups):
            for column, mode in enumerate(setup.modes):
                distances = [
                    distance(setups[k].modes[i], mode, indices[k], indices[number])
                    for k, i in group.items()
                ]
                cost[row, column] = min(np.mean(distances), FAR)
        rows, columns = scipy.optimize.linear_sum_assignment(cost)
        pairs = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if cost[r, c] < FAR}
        for column in range(len(setup.modes)):
            if column in pairs:
                groups[pairs[column]][number] = column
            else:
                groups.append({number: column})
    return groups


def lone_modes(
    setups: Sequence[ModalFit],
    indices: Sequence[np.ndarray],
    groups: Sequence[tuple[dict[int, int], dict]],
) -> dict[int, str]:
    """Groups (index) with one setup alone whose mode may be none, with the reason.

    `groups` are the pairs of each mode, and what `uncertain_modes` found for it. Such a mode may be
    noise if it is weak, or another estimate of a mode that several setups show.
    """
    several = [pairs for pairs, _ in groups if len(pairs) > 1]
    found = {}
    for number, (pairs, uncertain) in enumerate(groups):
        if len(pairs) + len(uncertain) > 1:
            continue
        ((own, index),) = pairs.items()
        mode = setups[own].modes[index]
        same = [
            setups[k].modes[i].frequency
            for group in several
            for k, i in group.items()
            if distance(setups[k].modes[i], mode, indices[k], indices[own], 0.0) < FAR
        ]
        if mode.energy_share < MIN_ENERGY_ALONE:
            found[number] = f"found in {setups[own].source} alone, and weak"
        elif same:
            found[number] = f"found in {setups[own].source} alone, where {same[0]:.4g} Hz may be it"
    return found


def uncertain_modes(
    setups: Sequence[ModalFit], indices: Sequence[np.ndarray], pairs: dict[int, int]
) -> dict[int, tuple[IdentifiedMode, str]]:
    """The rejected mode, with the reason, of each setup where a mode is not well identified.

    It has the frequency of those of all other setups within errors, and their shape at common
    channels. Poles without energy, and those at harmonic lines, are no modes.
    """
    found = {}
    for number, setup in enumerate(setups):
        near = []
        for mode, reason in setup.rejected if number not in pairs else ():
            distances = [
                distance(setups[k].modes[i], mode, indices[k], indices[number], 0.0)
                for k, i in pairs.items()
            ]
            width = max(mode.damping_ratio * mode.frequency, mode.frequency_sd)
            line = any(abs(one.frequency - mode.frequency) < width for one in setup.lines)
            if mode.energy_share >= MIN_ENERGY and not line and max(distances) < FAR:
                near.append((max(distances), len(near), mode, reason))
        if near:
            found[number] = min(near)[2:]
    return found


def distance(a: IdentifiedMode, b: IdentifiedMode, of_a, of_b, change=MAX_FREQUENCY_CHANGE):
    """Distance of two modes, of 2 at most; `FAR` if they are too unlike to be one.

    `of_a` and `of_b` are the channels of their shapes; `change` is the fraction by which
    frequencies may differ beyond their errors.
    """
    errors = MAX_SDS * np.hypot(a.frequency_sd, b.frequency_sd)
    limit = max(change * min(a.frequency, b.frequency), errors)
    apart = abs(a.frequency - b.frequency) / limit
    _, first, second = np.intersect1d(of_a, of_b, return_indices=True)
    mac = 1.0
    if first.size > 1:
        one, other = a.shape[first], b.shape[second]
        left = _left_by_errors(a, first) * _left_by_errors(b, second)
        mac = min(float(mac_matrix(one[None], other[None])[0, 0]) + 1 - left, 1.0)
    return FAR if not apart <= 1 or mac < MIN_MAC else float(apart + 1 - mac)


def _left_by_errors(mode: IdentifiedMode, channels: np.ndarray) -> float:
    """Expected modal assurance criterion of a shape with its errors and the true shape."""
    variances = Part(mode.shape, mode.shape_covariance, channels).variances[channels]
    error = np.sum(variances + NEAR_MODE_ERROR**2)
    size = np.sum(np.abs(mode.shape[channels]) ** 2)
    return float(max(size - error, 0.0) / max(size, 1e-300))


@dataclass(frozen=True, eq=False)
class MultiSetupFit(ModalEstimates):
    """Modes of several setups, ascending in frequency, with shapes at the channels of all.

    `setups` are the modes of each setup, `rejected` some that one setup alone shows, with the
    reason, and shapes at its channels. For each of `modes`, `pairs` holds the index of the mode in
    each setup that shows it well. `channels` are those of all setups, each place once;
    `references` the names of those that two setups or more have. `choices` are the automatic
    choices, with the options that override them; `notes` are sentences on modes that some setup
    lacks, and on setups that disagree.

    >>> import numpy as np
    >>> import tuning
    >>> times, random = 0.005 * np.arange(1600), np.random.default_rng(1)
    >>> decay = np.exp(-0.3 * times) * np.cos(2 * np.pi * 3.2 * times)
    >>> def setup(name, size):
    ...     values = np.multiply.outer(decay, [1.0, size]) + 1e-3 * random.normal(size=(1600, 2))
    ...     columns = ("a1", name), ("acceleration",) * 2, ("m/s^2",) * 2
    ...     return tuning.identify_modes(tuning.Log(times, values, *columns))
    >>> fit = tuning.modal.merge_setups([setup("a2", 0.5), setup("a3", -0.5)])
    >>> print(fit.channels.names, np.round(fit.shapes[0].real, 2))
    ('a1', 'a2', 'a3') [ 1.   0.5 -0.5]
    """

    modes: tuple[IdentifiedMode, ...]
    setups: tuple[ModalFit, ...]
    rejected: tuple[tuple[IdentifiedMode, str], ...]
    pairs: tuple[dict[int, int], ...]
    channels: Channels
    references: tuple[str, ...]
    choices: tuple[Choice, ...]
    notes: tuple[str, ...]

    @property
    def source(self) -> str:
        """Names of the logs of all setups."""
        return ", ".join(setup.source for setup in self.setups)

    def __str__(self) -> str:
        lines = [
            f"{len(self.setups)} setups: {self.source}",
            *(f"  {choice.text}  [{choice.option}]" for choice in self.choices),
            *(f"  {note}" for note in self.notes),
        ]
        numbers = [", ".join(str(k + 1) for k in sorted(pairs)) for pairs in self.pairs]
        lines += self._mode_lines("setups", numbers)
        if self.rejected:
            lines.append("  not well identified:")
        lines += [f"  {mode.frequency:14.4f}  {reason}" for mode, reason in self.rejected]
        return "\n".join(lines)

    def to_dict(self) -> dict:
        """Plain numbers for JSON: modes with 95 % intervals and shapes, and those of each setup."""
        return {
            "channels": list(self.channels.names),
            "positions_m": list(self.channels.positions),
            "references": list(self.references),
            "choices": [{"choice": c.text, "option": c.option} for c in self.choices],
            "notes": list(self.notes),
            "frequencies_hz": self.frequencies.tolist(),
            "damping_ratios": self.damping_ratios.tolist(),
            "modes": [
                {**mode.to_dict(), "setups": sorted(pairs)}
                for mode, pairs in zip(self.modes, self.pairs, strict=True)
            ],
            "mac": self.mac.tolist(),
            "rejected": [
                {"frequency_hz": mode.frequency, "damping_ratio": mode.damping_ratio, "why": why}
                for mode, why in self.rejected
            ],
            "setups": [setup.to_dict() for setup in self.setups],
        }

    def plot(self, path=None, length: float | None = None):
        """Figure of frequencies and damping ratios of each setup, and of the merged shapes.

        `length` (m) is that of the beam; it is saved to `path` if given.
        """
        from tuning.modal.plot import plot_setups

        return plot_setups(self, path, length)


UNLIKELY = 0.01  # probability by chance, below which setups are said to disagree


@refuses_traced("a modal fit")
def merge_setups(
    setups: Sequence[ModalFit], *, references: Sequence[str] | None = None
) -> MultiSetupFit:
    """Modes of a structure from those of several setups, at the channels of all of them.

    `references` are the names of the channels that stay at their places in all setups; all others
    are at other places then. By default channels of one name and quantity are one place, unless
    their positions in the logs differ.

    A mode that one setup alone shows is among `rejected` if it has less than 5 % of the energy, or
    may be a mode that several setups show.

    Raises ValueError for fewer than two setups, for references that a setup lacks, and for setups
    without a common channel.

    >>> import numpy as np
    >>> import tuning
    >>> times, random = 0.005 * np.arange(1600), np.random.default_rng(1)
    >>> decay = np.exp(-0.3 * times) * np.cos(2 * np.pi * 3.2 * times)
    >>> def setup(size):
    ...     values = np.multiply.outer(decay, [1.0, size]) + 1e-3 * random.normal(size=(1600, 2))
    ...     columns = ("fixed", "moved"), ("acceleration",) * 2, ("m/s^2",) * 2
    ...     return tuning.identify_modes(tuning.Log(times, values, *columns, f"{size}.csv"))
    >>> fit = tuning.modal.merge_setups([setup(0.5), setup(-0.8)], references=["fixed"])
    >>> print(f"{fit.frequencies[0]:.2f} Hz", np.round(fit.shapes[0].real, 2))
    3.20 Hz [ 1.   0.5 -0.8]
    """
    setups = tuple(setups)
    if len(setups) < 2:
        raise ValueError(f"merging takes the modes of two setups or more, not {len(setups)}")
    channels, indices = merged_channels(
        [setup.channels for setup in setups], [setup.source for setup in setups], references
    )
    shared = [i for i in range(len(channels.names)) if sum(i in own for own in indices) > 1]
    names = tuple(channels.names[i] for i in shared)
    groups = [
        (pairs, uncertain_modes(setups, indices, pairs)) for pairs in paired_modes(setups, indices)
    ]
    lone = lone_modes(setups, indices, groups)
    merged, rejected = [], []
    for number, (pairs, uncertain) in enumerate(groups):
        if number in lone:
            ((own, index),) = pairs.items()
            rejected.append((setups[own].modes[index], lone[number]))
        else:
            mode, of_mode = _merged(setups, indices, channels, pairs, uncertain)
            merged.append((mode, pairs, of_mode))
    merged.sort(key=lambda one: one[0].frequency)
    notes = [note for _, _, of_mode in merged for note in of_mode]
    if groups and all(len(pairs) == 1 for pairs, _ in groups):
        notes.insert(0, "no mode is common to two setups: are they of one structure?")
    chosen = f"references, the same in setups: {', '.join(names)}"
    return MultiSetupFit(
        modes=tuple(mode for mode, _, _ in merged),
        setups=setups,
        rejected=tuple(sorted(rejected, key=lambda one: one[0].frequency)),
        pairs=tuple(pairs for _, pairs, _ in merged),
        channels=channels,
        references=names,
        choices=() if references is not None else (Choice(chosen, "--references NAME,NAME,..."),),
        notes=tuple(notes),
    )


def _merged(setups, indices, channels: Channels, pairs, uncertain):
    """Merged mode of some setups, with the shapes of uncertain ones too, and notes on it."""
    modes = {k: setups[k].modes[pairs[k]] for k in sorted(pairs)}
    frequency, frequency_sd, moved = _mean([(m.frequency, m.frequency_sd) for m in modes.values()])
    damping, damping_sd, other = _mean([(m.damping_ratio, m.damping_sd) for m in modes.values()])
    with_shapes = modes | {k: mode for k, (mode, _) in uncertain.items()}
    shape = whole_shape(
        [Part(m.shape, m.shape_covariance, indices[k]) for k, m in with_shapes.items()],
        len(channels.names),
    )
    lacking = [k for k in range(len(setups)) if k not in pairs]
    notes = [
        f"{frequency:.4g} Hz: {_why_lacking(setups[k], frequency, uncertain.get(k))}"
        for k in lacking
    ]
    notes += [
        f"{frequency:.4g} Hz: the shape of {setups[k].source} cannot be scaled, as the mode hardly "
        "moves the common channels"
        for i, k in enumerate(with_shapes)
        if i not in shape.joined
    ]
    if lost := [channels.names[i] for i in np.flatnonzero(np.isnan(shape.shape))]:
        notes.append(f"{frequency:.4g} Hz: the shape is unknown at {', '.join(lost)}")
    for what, unlikely in (("frequencies", moved), ("damping ratios", other)):
        if unlikely:
            notes.append(
                f"{frequency:.4g} Hz: {what} of the setups differ by more than their errors, which "
                "are widened; temperature or traffic may have changed"
            )
    return IdentifiedMode(
        frequency=frequency,
        frequency_sd=frequency_sd,
        damping_ratio=damping,
        damping_sd=damping_sd,
        energy_share=float(np.mean([mode.energy_share for mode in modes.values()])),
        shape=shape.shape,
        shape_covariance=shape.covariance,
        quantile=float(np.mean([mode.quantile for mode in modes.values()])),
    ), notes


def _mean(estimates: Sequence[tuple[float, float]]) -> tuple[float, float, bool]:
    """Weighted mean of values, its standard deviation, and whether the values disagree."""
    values, deviations = np.array(estimates).T
    weights = 1 / np.maximum(deviations, 1e-9 * np.abs(values)) ** 2
    mean = np.sum(weights * values) / weights.sum()
    freedom = values.size - 1
    square = np.sum(weights * (values - mean) ** 2)
    ratio = np.sqrt(square / freedom) if freedom else 0.0
    unlikely = bool(freedom and chi2.sf(square, freedom) < UNLIKELY)
    return float(mean), float(max(ratio, 1.0) / np.sqrt(weights.sum())), unlikely


def _why_lacking(setup: ModalFit, frequency: float, uncertain) -> str:
    """Reason in words why a setup lacks a mode of some frequency (Hz)."""
    low, high = setup.band
    if uncertain:
        return f"of {setup.source} the shape alone is used: {uncertain[1]}"
    if not low <= frequency <= high:
        return f"not in {setup.source}, whose band is {low:.3g} Hz to {high:.4g} Hz  [--band]"
    return f"not found in {setup.source}"

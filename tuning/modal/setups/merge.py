"""Modes of several setups merged: sensors that move between records, beside references that stay.

    fit = merge_setups([identify_modes(read_log(path)) for path in ("north.csv", "south.csv")])

Modes of the setups are paired, their frequencies and damping ratios averaged with the inverse
variances as weights, and their shapes scaled to each other at the references (PoSER: Reynders,
Magalhaes, De Roeck and Cunha 2009; for all setups at once in `shape`). Where setups disagree by
more than their errors, these are widened by the ratio of both (Birge 1932).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from tuning.modal.fit import Choice, ModalFit
from tuning.modal.result import Channels, IdentifiedMode, ModalEstimates
from tuning.modal.setups.channels import merged_channels
from tuning.modal.setups.pairing import lone_modes, paired_modes, uncertain_modes
from tuning.modal.setups.shape import Part, whole_shape


@dataclass(frozen=True, eq=False)
class MultiSetupFit(ModalEstimates):
    """Modes of several setups, ascending in frequency, with shapes at the channels of all.

    `setups` are the modes of each setup, `rejected` some that one setup alone shows, with the
    reason, and shapes at its channels. For each of `modes`, `pairs` holds the index of the mode in
    each setup that shows it well. `channels` are those of all setups, each place once;
    `references` the names of those that two setups or more have. `choices` are the automatic
    choices, with what overrides them; `notes` tell which modes some setup lacks, and where setups
    disagree.

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
        """Figure of what each setup says of frequencies and damping ratios, and of the shapes.

        `length` (m) is that of the beam; it is saved to `path` if given.
        """
        from tuning.modal.plot import plot_setups

        return plot_setups(self, path, length)


UNLIKELY = 0.01  # probability by chance, below which setups are said to disagree


def merge_setups(
    setups: Sequence[ModalFit], *, references: Sequence[str] | None = None
) -> MultiSetupFit:
    """Modes of a structure from those of several setups, at the channels of all of them.

    `references` are the names of the channels that stay at their places in all setups; all others
    are at other places then. By default channels of one name and quantity are one place, unless
    the logs tell different positions of them.

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
    """One mode from those of some setups, and of the shapes of uncertain ones; notes on it."""
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
        notes.append(f"{frequency:.4g} Hz: the shape is not known at {', '.join(lost)}")
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
    """Weighted mean of values with standard deviations, its own, and whether values disagree."""
    values, deviations = np.array(estimates).T
    weights = 1 / np.maximum(deviations, 1e-9 * np.abs(values)) ** 2
    mean = np.sum(weights * values) / weights.sum()
    freedom = values.size - 1
    square = np.sum(weights * (values - mean) ** 2)
    ratio = np.sqrt(square / freedom) if freedom else 0.0
    unlikely = bool(freedom and chi2.sf(square, freedom) < UNLIKELY)
    return float(mean), float(max(ratio, 1.0) / np.sqrt(weights.sum())), unlikely


def _why_lacking(setup: ModalFit, frequency: float, uncertain) -> str:
    """Why a setup does not show a mode of some frequency (Hz), in words."""
    low, high = setup.band
    if uncertain:
        return f"of {setup.source} the shape alone is used: {uncertain[1]}"
    if not low <= frequency <= high:
        return f"not in {setup.source}, whose band is {low:.3g} Hz to {high:.4g} Hz  [--band]"
    return f"not found in {setup.source}"

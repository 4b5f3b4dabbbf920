"""Modes of a structure from several setups, with what each setup says of them."""

from dataclasses import dataclass

from tuning.modal.fit import Choice, ModalFit
from tuning.modal.result import Channels, IdentifiedMode, ModalEstimates


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
    >>> fit = tuning.merge_setups([setup("a2", 0.5), setup("a3", -0.5)])
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
        heading = "  frequency (Hz)  +- 95 %    damping ratio  +- 95 %     energy   setups"
        lines.append(heading if self.modes else "  no mode is well identified")
        for mode, pairs in zip(self.modes, self.pairs, strict=True):
            lines.append(f"{mode}   {', '.join(str(k + 1) for k in sorted(pairs))}")
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
        from tuning.modal.setups.plot import plot_setups

        return plot_setups(self, path, length)

"""What a fit says, in words and tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tuning.identify import Fit


def fit_table(fit: Fit) -> str:
    """A table of values with 95 % intervals, then what is unseen, correlated or at a bound."""
    width = max(len(address) for address in fit.addresses)
    lines = [f"{'number':{width}}  {'start':>11}  {'fitted':>11}  95 % interval"]
    for i, address in enumerate(fit.addresses):
        low, high = fit.intervals[i]
        if np.isfinite(fit.errors[i]):
            interval = f"{low:.5g} to {high:.5g}"
        else:
            interval = "the data cannot tell"
        mark = "  (at its bound)" if address in fit.at_bound else ""
        row = f"{address:{width}}  {fit.starts[i]:11.5g}  {fit.values[i]:11.5g}  {interval}{mark}"
        lines.append(row)
    lines += [""] + [_unseen_sentence(direction) for direction in fit.unseen]
    pairs = np.argwhere(np.triu(np.abs(np.nan_to_num(fit.correlation)) > 0.95, 1))
    for i, j in pairs:
        lines.append(
            f"{fit.addresses[i]} and {fit.addresses[j]} are hard to tell apart: "
            f"correlation {fit.correlation[i, j]:.3f}"
        )
    for log, noise in zip(fit.campaign.logs, fit.noise, strict=True):
        levels = ", ".join(f"{level:.3g}" for level in noise)
        lines.append(f"residual of {log.source}: {levels} (standard deviation, SI units)")
    lines.append(fit.verdict)
    return "\n".join(line for k, line in enumerate(lines) if line or k == len(fit.addresses) + 1)


def _unseen_sentence(direction: dict[str, float]) -> str:
    """One direction that the data cannot see, by name."""
    if len(direction) == 1:
        return f"the data cannot see {next(iter(direction))}: give it a value, or narrow bounds"
    parts = ", ".join(f"{address} ({share:+.2f})" for address, share in direction.items())
    return (
        f"the data cannot see a common change of {parts} (shares of their sizes): "
        "give one of them a value"
    )

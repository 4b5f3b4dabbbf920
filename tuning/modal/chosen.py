"""Modes that a user chooses among the poles of the stabilisation diagram, whatever the criteria."""

import math
from collections.abc import Sequence

from tuning.modal.result import IdentifiedMode

MAX_DISTANCE = 0.02  # of a frequency, of the mode that is chosen by it

Judged = tuple[IdentifiedMode, str]  # a mode and the reason for rejecting it, or none


def chosen_modes(
    judged: Sequence[Judged], frequencies: Sequence[float], source: str
) -> tuple[list[Judged], list[Judged], list[str]]:
    """The modes nearest to frequencies (Hz), the others, and what speaks against chosen ones.

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

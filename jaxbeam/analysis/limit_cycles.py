"""Oscillation of commands: turning points beyond those of the uncontrolled deflection."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.simulation.record import Record

MIN_REVERSAL = 0.2  # of the range of a history; smaller reversals are no turning points
MIN_EXTRA_TURNS = 4  # turning points beyond those without control: two cycles


class CommandOscillation(NamedTuple):
    """Oscillation of a command, compared with that of the uncontrolled deflection.

    `extra` is the number of turning points beyond those of the uncontrolled deflection, `at_limits`
    the number of turning points at a limit of the actuator, `frequency` (Hz) that of the turning
    points, half their rate (by the median interval), NaN if there are fewer than two.
    """

    extra: int
    frequency: float
    at_limits: int

    @property
    def oscillates(self) -> bool:
        """Whether the loop makes the command oscillate for two cycles or more."""
        return self.extra >= MIN_EXTRA_TURNS

    @property
    def limit_cycle(self) -> bool:
        """Whether the limits bound the oscillation: four turning points or more are at a limit."""
        return self.oscillates and self.at_limits >= MIN_EXTRA_TURNS


def command_oscillations(record: Record, uncontrolled: Record) -> tuple[CommandOscillation, ...]:
    """Oscillation of each command of a run, compared with the run without control.

    Command i is compared with the uncontrolled deflection at sensor i, or at the last sensor if
    there are fewer: turning points that follow the passing loads do not count.
    """
    deflection, last = np.asarray(uncontrolled.deflection), len(uncontrolled.case.sensors) - 1
    columns = zip(np.asarray(record.command).T, np.asarray(record.saturated).T, strict=True)
    return tuple(
        count_oscillations(np.asarray(record.times), *column, deflection[:, min(i, last)])
        for i, column in enumerate(columns)
    )


def count_oscillations(
    times: Float[np.ndarray, " time"],
    command: Float[np.ndarray, " time"],
    saturated: Bool[np.ndarray, " time"],
    deflection: Float[np.ndarray, " time"],
) -> CommandOscillation:
    """Oscillation of a command, compared with an uncontrolled deflection.

    `saturated` is where the command is at a limit.
    """
    command_turns, deflection_turns = turning_points(command), turning_points(deflection)
    gaps = np.diff(times[command_turns])
    frequency = float(1 / (2 * np.median(gaps))) if gaps.size else np.nan
    return CommandOscillation(
        max(len(command_turns) - len(deflection_turns), 0),
        frequency,
        int(np.sum(saturated[command_turns])),
    )


def turning_points(history: Float[np.ndarray, " time"]) -> list[int]:
    """Indices of extremes of a history before reversals of more than MIN_REVERSAL of its range.

    Empty for a history that is constant or not finite.
    """
    if not np.all(np.isfinite(history)) or np.ptp(history) == 0:
        return []
    min_reversal, turns, extreme, direction = MIN_REVERSAL * np.ptp(history), [], 0, 0.0
    for k, value in enumerate(history):
        change = value - history[extreme]
        if direction == 0:  # no change beyond MIN_REVERSAL so far
            if abs(change) > min_reversal:
                direction, extreme = np.sign(change), k
        elif direction * change >= 0:
            extreme = k
        elif abs(change) > min_reversal:
            turns, extreme, direction = [*turns, extreme], k, -direction
    return turns

"""Whether commands swing to and fro as those of an unstable loop do, and in a limit cycle."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.simulation.record import Record

MIN_SWING = 0.2  # of the whole span of a history: what turns back after less has not turned
MIN_EXTRA_SWINGS = 4  # swings more than without control: two whole cycles


class CommandOscillation(NamedTuple):
    """How a command swings: how often more than the deflection at its sensor does without control.

    `frequency` (Hz) is that of its swings, NaN if there are not two; `at_limits` counts those that
    end at a limit of the actuator.
    """

    extra: int
    frequency: float
    at_limits: int

    @property
    def oscillates(self) -> bool:
        """Whether it swings to and fro at least twice, on account of the loop."""
        return self.extra >= MIN_EXTRA_SWINGS

    @property
    def limit_cycle(self) -> bool:
        """Whether it is the limits that hold the swings: four or more of them end there."""
        return self.oscillates and self.at_limits >= MIN_EXTRA_SWINGS


def command_oscillations(record: Record, uncontrolled: Record) -> tuple[CommandOscillation, ...]:
    """How each command of a run swings, beside the run without control.

    The first command is held against the first sensor, the second against the second, and so on;
    further ones against the last. What the passing loads themselves make a command do is left out
    by that.
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
    """How a command swings, at a limit where it is `saturated`, beside a deflection of the beam."""
    command_turns, deflection_turns = turning_points(command), turning_points(deflection)
    gaps = np.diff(times[command_turns])
    frequency = float(1 / (2 * np.median(gaps))) if gaps.size else np.nan
    return CommandOscillation(
        max(len(command_turns) - len(deflection_turns), 0),
        frequency,
        int(np.sum(saturated[command_turns])),
    )


def turning_points(history: Float[np.ndarray, " time"]) -> list[int]:
    """Where a history turns back by more than a share of its whole span: places of its extremes."""
    if not np.all(np.isfinite(history)) or np.ptp(history) == 0:
        return []
    min_swing, turns, extreme, direction = MIN_SWING * np.ptp(history), [], 0, 0.0
    for k, value in enumerate(history):
        change = value - history[extreme]
        if direction == 0:  # until it has moved at all
            if abs(change) > min_swing:
                direction, extreme = np.sign(change), k
        elif direction * change >= 0:
            extreme = k
        elif abs(change) > min_swing:
            turns, extreme, direction = [*turns, extreme], k, -direction
    return turns

"""What is lost or late at random: readings of sensors and commands of a controller, by a seed."""

from typing import Any

from jaxtyping import Bool, Float

from jaxbeam.numerics.normal_samples import uniform_samples
from jaxbeam.runtime.arrays import Array, xp

COMMANDS = -1  # the number that stands for the commands, among those of the sensors
LOSSES, DELAYS = 1, 2  # streams of random numbers within that of a sensor or of the commands


def sent_readings(
    seed: int, number: int, part: Any, count: int
) -> tuple[Bool[Array, " sample"] | None, Float[Array, " sample"] | None]:
    """Which of the first readings of a sensor are lost, and their random delays (s); None for none.

    `part` has `dropout` and `jitter`: a sensor of this number, or a controller for its COMMANDS.
    """
    losses = late = None
    if part.dropout is not None:
        losses = xp.asarray(uniform_samples(seed, (number + 1, LOSSES), count)) < part.dropout
    if part.jitter is not None:
        late = part.jitter * uniform_samples(seed, (number + 1, DELAYS), count)
    return losses, late

"""What is lost or late at random: readings of sensors and commands of a controller, by a seed."""

from typing import Any

from jaxtyping import Bool, Float

from jaxbeam.numerics.normal_samples import uniform_samples
from jaxbeam.runtime.arrays import Array, not_differentiated, xp

COMMANDS = -1  # the number that stands for the commands, among those of the sensors
LOSSES, DELAYS = 1, 2  # streams of random numbers within that of a sensor or of the commands

NO_DERIVATIVE = (
    "what {1} is drawn by a seed and jumps with the {0}, so that there is no derivative by it:"
    " compare several of its values"
)


def refuse_derivatives(part: Any) -> None:
    """Raise ValueError if there are derivatives by dropout or jitter of a part of a loop."""
    for name, what in (("dropout", "is lost"), ("jitter", "is late in a loop")):
        not_differentiated(getattr(part, name), NO_DERIVATIVE.format(name, what))


def sent_readings(
    seed: int, number: int, part: Any, count: int
) -> tuple[Bool[Array, " sample"] | None, Float[Array, " sample"] | None]:
    """Which of the first readings of a sensor are lost, and their random delays (s); None for none.

    `part` has `dropout` and `jitter`: a sensor of this number, or a controller for its COMMANDS.
    Derivatives by the dropout raise ValueError.
    """
    losses = late = None
    if part.dropout is not None:
        dropout = not_differentiated(part.dropout, NO_DERIVATIVE.format("dropout", "is lost"))
        losses = xp.asarray(uniform_samples(seed, (number + 1, LOSSES), count)) < dropout
    if part.jitter is not None:
        late = part.jitter * uniform_samples(seed, (number + 1, DELAYS), count)
    return losses, late

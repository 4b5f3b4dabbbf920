"""Commands as the actuators receive them: rounded, and within their limits and rate limits."""

from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.sensing.sensor_signals import ROUNDED
from jaxbeam.runtime.arrays import Array, not_differentiated, stop_gradient, xp

CommandRanges = tuple[Float[Array, " actuator"], ...]


def command_ranges(case: Case) -> CommandRanges:
    """Lowest and highest command and rate limit (1/s) of each actuator; infinite without one."""
    limits = [actuator.command_limits() for actuator in case.actuators]
    rates = [actuator.command_rate_limit() for actuator in case.actuators]
    low = xp.array([-xp.inf if pair is None else pair[0] for pair in limits])
    high = xp.array([xp.inf if pair is None else pair[1] for pair in limits])
    return low, high, xp.array([xp.inf if rate is None else rate for rate in rates])


def acting_ranges(case: Case) -> CommandRanges:
    """Bounds of the commands that act, behind hysteresis and creep, and of their rates (1/s)."""
    low, high, rate = command_ranges(case)
    actuators = case.actuators
    if all(one.hysteresis is None and one.creep is None for one in actuators):
        return low, high, rate
    creeps = xp.stack([xp.ones(()) if a.creep is None else a.creep.final_gain for a in actuators])

    def acts(ends):
        """Commands that act in the end at these ends of the ranges."""
        return creeps * xp.stack(
            [
                end
                if a.hysteresis is None
                else xp.where(xp.isinf(end), end, a.hysteresis.first_output(end))
                for end, a in zip(ends, actuators, strict=True)
            ]
        )

    slopes = [
        xp.ones(()) if a.hysteresis is None else xp.sum(a.hysteresis.weights) for a in actuators
    ]
    return acts(low), acts(high), rate * creeps * xp.stack(slopes)


def limit_commands(
    case: Case,
    commands: Float[Array, "actuator *batch"],
    previous: Float[Array, "actuator *batch"] | None = None,
    ranges: CommandRanges | None = None,
) -> Float[Array, "actuator *batch"]:
    """Commands rounded to the resolution of the controller, then limited by each actuator.

    Rate limits apply over a sampling period from the `previous` commands. `ranges` are what
    `command_ranges` returns, computed again if left out. Derivatives ignore the rounding; those by
    the resolution raise ValueError.
    """
    controller = case.controller
    if controller.resolution is not None:
        step = not_differentiated(controller.resolution, ROUNDED)
        rounded = step * xp.round(commands / step)
        commands = commands + stop_gradient(rounded - commands)
    low, high, rate = (
        part.reshape(-1, *[1] * (commands.ndim - 1)) for part in ranges or command_ranges(case)
    )
    commands = xp.clip(commands, low, high)
    if previous is not None and any(a.command_rate_limit() is not None for a in case.actuators):
        change = rate * controller.period
        commands = xp.clip(commands, previous - change, previous + change)
    return commands

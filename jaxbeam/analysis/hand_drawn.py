"""A feedforward table from statics alone: the baseline with which other laws are compared."""

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.controller import commanded
from jaxbeam.case.fields import concrete
from jaxbeam.control.feedforward import Feedforward
from jaxbeam.model.deflection_lines import influence_line, static_deflection_per_command

POINTS = 21  # of the table, over the crossing
RAMP_UP, RAMP_DOWN = 0.2, 0.1  # fractions of the crossing, at entry and exit
MIN_LIFT = 0.1  # of the largest lift of an actuator, below which it does not act
GATE_POSITIONS = -0.25, -0.08  # gates before the beam, in lengths of it, where none are given


def hand_drawn_law(
    case: Case, period: float = 0.01, delay: float = 0.0, gates: tuple[float, float] | None = None
) -> Feedforward:
    """Feedforward tabulated over the position of the load, from statics and limits alone.

    Each actuator lifts the beam at the load by its part of the static deflection under the heaviest
    load of the case, within its limits; the table of a weak actuator is a trapezium. It has ramps
    over the first fifth and the last tenth of the crossing, and is read ahead by the delay and half
    a period. `gates` (m) are by default a quarter and a twelfth of the length before the beam.

    Raises ValueError for a case without loads or without actuators that take commands, and as
    `influence_line` does.
    """
    active = commanded(case.actuators)
    if not case.loads or not active:
        raise ValueError("a law by hand needs a load and an actuator that takes commands")
    length = float(concrete(case.beam.length))
    fractions = np.linspace(0.0, 1.0, POINTS)
    leftwards = np.asarray(concrete(case.loads[0].trajectory(case.beam.length).direction())) < 0
    places = length * (1.0 - fractions if leftwards else fractions)
    lift = np.asarray(static_deflection_per_command(case, places))
    deflection = np.diagonal(np.asarray(influence_line(case, places, places)))
    gravity = case.run.gravity
    weights = [np.sum(concrete(load.vehicle(gravity).static_loads)) for load in case.loads]
    ramp = np.minimum(1.0, np.minimum(fractions / RAMP_UP, (1.0 - fractions) / RAMP_DOWN))
    rows = []
    for i in active:
        able = np.abs(lift[i]) > MIN_LIFT * np.abs(lift[i]).max()
        command = -max(weights) * deflection / np.where(able, lift[i], np.inf) / len(active)
        limits = case.actuators[i].command_limits()
        rows.append(ramp * (command if limits is None else np.clip(command, *concrete(limits))))
    if gates is None:
        first, second = (length * (1 - x if leftwards else x) for x in GATE_POSITIONS)
        gates = first, second
    return Feedforward(
        gates=list(gates),
        shares=fractions,
        values=np.array(rows),
        lead=delay + period / 2,
        period=period,
        delay=delay,
    )

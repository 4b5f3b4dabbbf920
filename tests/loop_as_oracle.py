"""Conversion of a case with a controller to the independent closed loop of `oracles`."""

import jax
import numpy as np

from jaxbeam.case.actuators.base import Shaker
from jaxbeam.case.case import Case
from jaxbeam.case.loads.base import MovingMass
from jaxbeam.control.feedback import Feedback
from jaxbeam.control.state_controller import StateFeedback
from tests.oracles import closed_loop, finite_elements
from tests.oracles.crossing import Load
from tests.oracles.modal_equations import Span
from tests.oracles.two_spans import TwoSpans


def span_of(case: Case) -> Span | TwoSpans:
    """One pinned span, or two equal spans for a case with a support."""
    beam = case.beam
    numbers = beam.length, beam.bending_stiffness, beam.linear_density
    kind = TwoSpans if case.supports else Span
    return kind(*map(float, numbers), beam.modes, float(beam.damping_ratio))


def parts_of(case: Case) -> tuple[Span | TwoSpans, list, list, list]:
    """Span, loads, actuators and sensors of a case whose loads have given speeds."""
    loads = [
        Load(
            float(load.mass),
            float(load.speed),
            float(load.entry_time),
            kind="mass" if isinstance(load, MovingMass) else "force",
        )
        for load in case.loads
    ]
    actuators = [_actuator(actuator) for actuator in case.actuators]
    sensors = [_sensor(sensor, *_way(case, i, sensor)) for i, sensor in enumerate(case.sensors)]
    return span_of(case), loads, actuators, sensors


def _way(case: Case, number: int, part) -> tuple[list[bool], list[float]]:
    """Which readings of a sensor, or commands (number -1), are lost, and their random delays."""

    def uniform(stream):
        key = jax.random.fold_in(jax.random.key(case.run.seed), number + 1)
        return np.asarray(jax.random.uniform(jax.random.fold_in(key, stream), 10_000))

    losses = [] if part.dropout is None else uniform(1) < float(part.dropout)
    late = [] if part.jitter is None else uniform(2) * float(part.jitter)
    return list(losses), list(late)


def expected(case: Case, times, law: closed_loop.Law | None = None) -> closed_loop.Motion:
    """Motion of a case at times (s) by the oracle, under its own law or another."""
    controller, clock = case.controller, None
    if controller.period is not None:
        delay = _number(controller.delay) or 0.0
        period = float(controller.period)
        clock = closed_loop.Clock(
            period, delay, _number(controller.resolution), *_way(case, -1, controller)
        )
    breakpoints = controller.breakpoints(case)
    return closed_loop.respond(
        *parts_of(case),
        _law(controller) if law is None else law,
        np.asarray(times).tolist(),
        clock,
        [] if breakpoints is None else np.asarray(breakpoints).tolist(),
    )


def _actuator(actuator) -> closed_loop.Actuator:
    device, limits = actuator.attachment(), actuator.command_limits()
    gain, lag = device.feedthrough, None
    if isinstance(actuator, Shaker):
        gain, lag = actuator.force_per_volt, float(actuator.bandwidth)
    return closed_loop.Actuator(
        [(float(x), order, factor) for x, order, factor in actuator.displacement_map()],
        float(gain),
        lag,
        float(device.stiffness),
        float(device.damping),
        None if limits is None else tuple(np.asarray(limits).tolist()),
        _number(actuator.command_rate_limit()),
    )


def _sensor(sensor, lost, late) -> closed_loop.Sensor:
    filter = {}
    if sensor.filter is not None:
        analogue = sensor.filter.realisation == "analogue"
        cutoff = float(sensor.filter.cutoff)
        filter = {"order": sensor.filter.order, "cutoff": cutoff, "analogue": analogue}
    return closed_loop.Sensor(
        float(sensor.position),
        sensor.quantity,
        _number(sensor.fibre_distance) or 0.0,
        float(sensor.offset),
        None if sensor.range is None else tuple(np.asarray(sensor.range).tolist()),
        _number(sensor.resolution),
        period=_number(sensor.sampling_period),
        delay=_number(sensor.delay) or 0.0,
        lost=lost,
        late=late,
        **filter,
    )


def _law(controller) -> closed_loop.Law:
    if isinstance(controller, Feedback):
        rows = [controller.gains]
        rows += [] if controller.higher_gains is None else list(controller.higher_gains)
        powers = controller.power + 2 * np.arange(len(rows))

        def feedback(readings, *_):
            own = readings[: len(controller.gains)]
            terms = zip(np.asarray(rows), powers, strict=True)
            return -sum(gains * own * np.abs(own) ** (power - 1) for gains, power in terms)

        return feedback
    if isinstance(controller, StateFeedback):
        gain = np.asarray(controller.gain)
        return lambda _, state, t: -gain @ state

    def prescribed(_, state, t):
        command = np.array(controller.offsets)
        if controller.amplitudes is not None:
            angle = 2 * np.pi * np.asarray(controller.frequencies) * t
            angle = angle + (0.0 if controller.phases is None else np.asarray(controller.phases))
            command = command + (np.asarray(controller.amplitudes) * np.sin(angle)).sum(axis=1)
        if controller.times is not None:
            for i, row in enumerate(np.asarray(controller.values)):
                command[i] += np.interp(t, controller.times, row, left=0.0, right=0.0)
        return command

    return prescribed


def _number(value) -> float | None:
    return None if value is None else float(value)


# Cases as models of the independent finite-element oracle.


def as_oracle(case: Case, elements: int = 40) -> finite_elements.Beam:
    """Finite-element beam of a case with supports, patches and suspensions, without loads."""
    stiffenings = [
        b for b in (actuator.section_stiffening() for actuator in case.actuators) if b is not None
    ]
    attachments = [(a.displacement_map(), a.attachment()) for a in case.actuators]
    supports = [
        finite_elements.Support(
            float(s.position),
            None if s.stiffness is None else float(s.stiffness),
            0.0 if s.damping is None else float(s.damping),
            float(s.rotational_stiffness),
        )
        for s in case.supports
    ]
    return finite_elements.Beam(
        float(case.beam.length),
        float(case.beam.bending_stiffness),
        float(case.beam.linear_density),
        case.beam.ends,
        supports,
        [
            finite_elements.Patch(
                float(b.start), float(b.end), float(b.bending_stiffness), float(b.mass_per_length)
            )
            for b in stiffenings
        ],
        [
            finite_elements.Suspension(
                float(displacement_map[0][0]), float(a.stiffness), float(a.damping)
            )
            for displacement_map, a in attachments
            if len(displacement_map) == 1 and displacement_map[0][1] == 0
        ],
        elements=elements,
    )

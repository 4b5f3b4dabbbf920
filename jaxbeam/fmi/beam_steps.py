"""Beam with its loads, step by step under held commands, for co-simulation."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.validation import check_case
from jaxbeam.estimation.sampled_plant import SampleTiming
from jaxbeam.integrator.kinks import may_have_kinks
from jaxbeam.model.state_space import state_space
from jaxbeam.numerics.discretisation import balance

STEP_OF_FASTEST = 0.1  # of a radian of the fastest mode, the longest step of Magnus' method


class BeamSteps:
    """Beam, supports, actuators and loads of a case, integrated step by step from rest at t = 0.

    Commands are held over a step of any length, within the limits of the actuators. Steps are
    split where wheels enter and leave the beam, and go by Magnus' method of order 4 in between;
    readings are those of ideal sensors, in SI units. The controller of the case is left out.

    Raises ValueError for an invalid case, for actuators with hysteresis or creep, and for rigid
    wheels over kinks, whose impulses only `simulate` has.

    >>> import jaxbeam as jb
    >>> from jaxbeam.fmi import BeamSteps
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ... )
    >>> beam = BeamSteps(case)
    >>> beam.step(0.04)
    >>> beam.step(0.01)
    >>> print(f"{beam.time:.2f} s, {1e3 * beam.readings[0]:.3f} mm")
    0.05 s, -1.467 mm
    """

    def __init__(self, case: Case):
        check_case(case)
        case = concrete_case(dataclasses.replace(case, controller=None))
        for i, actuator in enumerate(case.actuators):
            if actuator.hysteresis is not None or actuator.creep is not None:
                raise ValueError(
                    f"actuators.{i} has a hysteresis or creep, which only a sampled loop has: leave"
                    " it out of the beam that is exported"
                )
        if may_have_kinks(case):
            raise ValueError(
                "rigid wheels pass a kink of their path, and the impulse there is in no exported"
                " beam: take sprung wheels, or a path without kinks"
            )
        self._plant = state_space(case)
        self._state = np.concatenate(
            [np.zeros(len(self._plant.states)), np.asarray(self._plant.augmented_start)]
        )
        start = self._plant.augmented(0.0)
        self._scale = np.asarray(balance(np.asarray(start.A)))
        fastest = np.max(np.abs(np.linalg.eigvals(np.asarray(self._plant.unloaded.A))), initial=1.0)
        self._longest = STEP_OF_FASTEST / fastest
        loads = self._plant.loads
        windows, others = loads.events(np.zeros(0))
        times = np.unique(np.concatenate([np.ravel(windows), np.ravel(others)]))
        self._events = times[(times > 0) & (times < 1e30)]
        limits = [actuator.command_limits() for actuator in case.actuators]
        self._low = np.array([-np.inf if pair is None else pair[0] for pair in limits])
        self._high = np.array([np.inf if pair is None else pair[1] for pair in limits])
        self.commands = np.zeros(len(case.actuators))
        self.time = 0.0

    def step(self, duration: float, commands: ArrayLike | None = None) -> None:
        """Advance by a `duration` (s) under `commands` (V, A or N), the last ones if None.

        Raises ValueError for a duration that is not positive.
        """
        if not duration > 0:
            raise ValueError(f"a step must last longer than {duration:g} s")
        if commands is not None:
            self.commands = np.clip(np.asarray(commands, float), self._low, self._high)
        end = self.time + duration
        within = self._events[(self._events > self.time) & (self._events < end)]
        edges = np.concatenate([[self.time], within, [end]])
        for first, last in zip(edges[:-1], edges[1:], strict=True):
            self._advance(first, last)
        self.time = end

    @property
    def readings(self) -> Float[np.ndarray, " sensor"]:
        """Readings of the ideal sensors at the present time, under the last commands."""
        system = self._plant.augmented(self.time)
        return np.asarray(system.C @ self._state + system.D @ self.commands)

    def _advance(self, start: float, end: float) -> None:
        """Advance the state over an interval (s) without events."""
        steps = max(1, math.ceil((end - start) / self._longest))
        span = (end - start) / steps
        size, actuators = self._state.size, self.commands.size

        def matrices(times):
            system = self._plant.augmented(times)
            B = np.broadcast_to(np.asarray(system.B), (*np.shape(times), size, actuators))
            return np.asarray(system.A), B

        ends = start + span * np.arange(1, steps + 1)
        timing = SampleTiming(np.asarray(span), None)
        found = timing.transition(matrices, np.zeros((size, size)), self._scale, ends)
        inputs = np.asarray(found.input_matrix) @ self.commands
        for matrix, own in zip(np.asarray(found.matrix), inputs, strict=True):
            self._state = matrix @ self._state + own

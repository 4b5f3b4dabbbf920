"""Controllers and estimators: the settings in a case, and the interfaces of what they design.

A controller holds the settings of a case file. For a plant it designs a control law, which turns
measurements into commands: at samples, or in continuous time. Controllers are in `jaxbeam.control`.

An estimator holds the settings of a case file. For a plant it designs a filter, which turns
readings into an estimate of the state, at samples or in continuous time, for a law that feeds back
the state. Estimators are in `jaxbeam.control.estimation`.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.display import ExplainsArguments, ReprWithUnits
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, PROBABILITY, number
from jaxbeam.runtime.arrays import Array, Module, Number, set_at, xp

Command = Float[Array, " actuator"]
Time = Float[Array, ""]


class Measurement(NamedTuple):
    """Inputs of a control law at one time: readings of the sensors, each in its own SI unit.

    `state` is the true state of the plant in the order of `state_space`, for laws that assume full
    state information; no sensor measures it. `command` is the last command of the actuators, after
    limits and resolution. `present` is False for the sensors whose reading is missing at the
    sample, in whose place `readings` have the last one that came; None if none is missing.
    """

    readings: Float[Array, " sensor"]
    state: Float[Array, " state"]
    command: Command
    present: Bool[Array, " sensor"] | None = None

    def innovation(self, predicted: Float[Array, " sensor"]) -> Float[Array, " sensor"]:
        """Readings less predicted ones; zero where a reading is missing."""
        innovation = self.readings - predicted
        return innovation if self.present is None else xp.where(self.present, innovation, 0.0)

    def complete(self, sensors: Sequence[int]) -> Bool[Array, ""] | bool:
        """Whether the readings of some sensors are all present."""
        return True if self.present is None else xp.all(self.present[np.array(sensors, int)])


class ControllerFilter(Module):
    """Continuous filter of the readings y of one sensor: x' = A x + B y, output C x + D y."""

    sensor: int = eqx.field(static=True)
    A: Float[Array, "state state"]
    B: Float[Array, " state"]
    C: Float[Array, " state"]
    D: Float[Array, ""]


class ControlStep(NamedTuple):
    """Result of one sample of a law: command, its state afterwards, and whether it was solved.

    A law that solves a problem at each sample says False where it found no solution and fell back.
    """

    command: Command
    state: Any
    solved: Bool[Array, ""] | bool = True


class AbstractSampledLaw(Module):
    """Control law at samples, (u_k, x_k+1) = step(x_k, y_k, t_k), with a state x of any structure.

    Fields of the class are the design; they do not change during a run.
    """

    def initial_state(self) -> Any:
        """State at the start of a run; empty for a static law."""
        return ()

    @abc.abstractmethod
    def step(self, state: Any, measurement: Measurement, t: Time) -> ControlStep:
        """Command, in the units of the actuators, and next state at a sample at t (s)."""

    def tabulated(self, times: Float[Array, " sample"]) -> "AbstractSampledLaw":
        """The law with its time-dependent matrices tabulated at the sampling `times` of a run (s).

        In NumPy, all of them at once take a small part of the time of one after the other.
        """
        return self


class AbstractContinuousLaw(Module):
    """Control law in continuous time, u = command(x, y, t), x' = rates(x, y, u, t), from x = 0.

    Its states are integrated together with those of the plant. Outputs of its `filters` follow the
    readings of the sensors in the measurement.
    """

    @property
    def filters(self) -> tuple[ControllerFilter, ...]:
        """Filters of single readings, integrated with the plant."""
        return ()

    @property
    def state_count(self) -> int:
        """Number of states x, without those of the filters."""
        return 0

    @abc.abstractmethod
    def command(
        self, state: Float[Array, " law_state"], measurement: Measurement, t: Time
    ) -> Command:
        """Command at t (s), before limits, in the units of the actuators."""

    def rates(
        self, state: Float[Array, " law_state"], measurement: Measurement, command: Command, t: Time
    ) -> Float[Array, " law_state"]:
        """Rates of the states (1/s) under the command that the actuators receive."""
        return xp.zeros_like(state)


class AbstractStaticLaw(AbstractSampledLaw, AbstractContinuousLaw):
    """Control law without a state: the same command at samples and in continuous time."""

    def step(self, state, measurement, t):
        return ControlStep(self.command(state, measurement, t), state)


class LawOfCommanded(AbstractSampledLaw, AbstractContinuousLaw):
    """Control law of the `active` ones of `count` actuators; the others receive no command."""

    law: Any
    active: tuple[int, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)

    @property
    def filters(self):
        return self.law.filters

    @property
    def state_count(self):
        return self.law.state_count

    def initial_state(self):
        return self.law.initial_state()

    def tabulated(self, times):
        return dataclasses.replace(self, law=self.law.tabulated(times))

    def step(self, state, measurement, t):
        command, state, solved = self.law.step(state, self._own(measurement), t)
        return ControlStep(self._all(command), state, solved)

    def command(self, state, measurement, t):
        return self._all(self.law.command(state, self._own(measurement), t))

    def rates(self, state, measurement, command, t):
        own = command[np.array(self.active)]
        return self.law.rates(state, self._own(measurement), own, t)

    def _own(self, measurement: Measurement) -> Measurement:
        return measurement._replace(command=measurement.command[np.array(self.active)])

    def _all(self, command) -> Command:
        return set_at(xp.zeros(self.count), np.array(self.active), command)


def commanded(actuators: Sequence[Any]) -> tuple[int, ...]:
    """Indices of the actuators that take commands: all but springs and dampers."""
    return tuple(i for i, actuator in enumerate(actuators) if actuator.command_unit != "1")


class AbstractController(ReprWithUnits, Module, metaclass=ExplainsArguments):
    """Law that computes commands to the actuators from readings of the sensors, and its settings.

    With a sampling `period` (s) its law acts at 0, period, 2 period, ...; a command begins `delay`
    (s) later and is held until the next one. Without a period the law acts in continuous time.
    Commands are rounded to `resolution` and kept within the limits of the actuators by the closed
    loop. With the probability `dropout` a command is lost on its way, so that the last one stays;
    the others begin up to `jitter` (s) later, equally distributed, and not at all after a newer
    one. Both are drawn by the seed of the run, and the law does not know of them. Where
    `nominal_plant` is given, the law is designed for that plant instead of the plant of its case;
    no key of a case file. Settings and laws have entries for the actuators that take commands
    (`Case.driven`), not for springs and dampers among them.

    To add a controller, write a file in `jaxbeam.control` with a subclass that names its `kind`.
    """

    kind: ClassVar[str]
    open_loop: ClassVar[bool] = False  # whether the command depends on time alone

    period: Float[Number, ""] | None = number(
        "s", "sampling period; continuous time if left out", POSITIVE, default=None, kw_only=True
    )
    delay: Float[Number, ""] | None = number(
        "s", "from measurement to command", NOT_NEGATIVE, default=None, kw_only=True
    )
    resolution: Float[Number, ""] | None = number(
        "unit of a command", "step between commands", POSITIVE, default=None, kw_only=True
    )
    dropout: Float[Number, ""] | None = number(
        "1", "probability that a command is lost", PROBABILITY, default=None, kw_only=True
    )
    jitter: Float[Number, ""] | None = number(
        "s", "largest random delay of a command", NOT_NEGATIVE, default=None, kw_only=True
    )
    nominal_plant: Any = eqx.field(default=None, kw_only=True)

    @property
    def design_depends_on_loads(self) -> bool:
        """Whether the design depends on masses and weights of the loads."""
        return True

    @property
    def design_depends_on_paths(self) -> bool:
        """Whether the design depends on speeds and entry times of the loads."""
        return self.design_depends_on_loads

    @abc.abstractmethod
    def design_law(self, plant: Any) -> Any:
        """Law designed for a plant, a `jaxbeam.model.state_space.Plant`.

        An `AbstractSampledLaw` if the controller has a period, else an `AbstractContinuousLaw`.
        """

    def law(self, plant: Any) -> Any:
        """Law designed for the nominal plant, or for the plant of the case if there is none."""
        plant = plant if self.nominal_plant is None else self.nominal_plant
        if plant is None or len(plant.case.driven) == len(plant.case.actuators):
            return self.design_law(plant)
        active, count = commanded(plant.case.actuators), len(plant.case.actuators)
        return LawOfCommanded(self.design_law(plant.of_driven()), active, count)

    def validate(self, case: Any) -> str | None:
        """Error of these settings in a case, as "key must ...", or None; before any compilation."""
        return None

    def breakpoints(self, case: Any) -> Float[Array, " breakpoint"] | None:
        """Times (s) at which the command bends or jumps by itself; integration steps end there."""
        return None


class AbstractStaticController(AbstractController, AbstractStaticLaw):
    """Controller that is its own law: there is nothing to design and no state."""

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    def design_law(self, plant):
        return self


class EstimatedLoads(NamedTuple):
    """Masses (kg), positions (m) and speeds (m/s, negative to the left) of loads of one wheel."""

    masses: Float[Array, " load"]
    positions: Float[Array, " load"]
    speeds: Float[Array, " load"]


class Estimate(NamedTuple):
    """Estimate of the state of the plant, and of the weights of the loads (N) if estimated too.

    The state is that of the beam of the plant for which the filter is designed. `weights` has one
    entry for each wheel of the case, zero while it is off the beam; None where weights are not
    estimated. `vehicles` are the states of vehicles, None where the filter does not have them;
    `loads` are the loads of a filter that follows their masses and speeds, else None.
    """

    state: Float[Array, " state"]
    weights: Float[Array, " wheel"] | None = None
    vehicles: Float[Array, " vehicle_state"] | None = None
    loads: EstimatedLoads | None = None


class AbstractSampledFilter(Module):
    """Filter at samples: (estimate, x_k+1) = update(x_k, y_k, t_k), x of any structure.

    Fields of the class are the design; they do not change during a run.
    """

    def initial_state(self) -> Any:
        """State of the filter at the start of a run."""
        return ()

    @abc.abstractmethod
    def update(self, state: Any, measurement: Measurement, t: Time) -> tuple[Estimate, Any]:
        """Estimate at a sample at t (s), and the next state of the filter."""

    def tabulated(self, times: Float[Array, " sample"]) -> "AbstractSampledFilter":
        """The filter with its time-dependent matrices tabulated at the `times` of a run (s)."""
        return self


class AbstractContinuousFilter(Module):
    """Filter in continuous time, x' = rates(x, y, u, t), from x = 0, integrated with the plant."""

    @property
    def state_count(self) -> int:
        """Number of states x."""
        return 0

    @abc.abstractmethod
    def estimate(
        self, state: Float[Array, " filter_state"], measurement: Measurement, t: Time
    ) -> Estimate:
        """Estimate at t (s)."""

    @abc.abstractmethod
    def rates(
        self,
        state: Float[Array, " filter_state"],
        measurement: Measurement,
        command: Command,
        t: Time,
    ) -> Float[Array, " filter_state"]:
        """Rates of the states x (1/s) under a command."""


class AbstractEstimator(ReprWithUnits, Module, metaclass=ExplainsArguments):
    """Estimate of the state from readings, at the samples of a controller, and its settings.

    To add one, write a file in `jaxbeam.control.estimation` with a subclass that names its `kind`.
    """

    kind: ClassVar[str]
    continuous_time: ClassVar[bool] = False  # whether it has a filter in continuous time

    @property
    def has_vehicles(self) -> bool:
        """Whether estimates have the states of vehicles."""
        return False

    @property
    def varies(self) -> bool:
        """Whether the gain changes as the loads cross, so that a loop has no equilibrium.

        Otherwise the filter depends on no number of the loads.
        """
        return False

    @abc.abstractmethod
    def sampled_filter(self, plant: Any, timing: Any) -> AbstractSampledFilter:
        """Filter at samples, designed for a `jaxbeam.model.state_space.Plant`.

        `timing` is the `jaxbeam.control.estimation.sampled_plant.SampleTiming` of the controller.
        """

    def continuous_filter(self, plant: Any) -> AbstractContinuousFilter:
        """Filter in continuous time, designed for a plant.

        Raises NotImplementedError if the estimator acts at samples only.
        """
        raise NotImplementedError(f"{type(self).__name__} acts at samples only")

    def validate(self, case: Any, system: Any) -> str | None:
        """Error of these settings in a case, as "key must ...", or None; before any compilation.

        Called twice: with None for the system; then, where all numbers are concrete (not inside
        `jit`), with the plant of the design without loads, a `state_space.StateSpace`.
        """
        return None

"""Controllers whose law feeds back the state of a design model, true or estimated.

A design model has the plant parameters of the design where they differ from the case.
"""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.controller import (
    AbstractContinuousFilter,
    AbstractContinuousLaw,
    AbstractController,
    AbstractEstimator,
    AbstractSampledFilter,
    AbstractSampledLaw,
    ControlStep,
    Estimate,
    Measurement,
    Time,
)
from jaxbeam.case.fields import NOT_NEGATIVE, choice, concrete, count, is_concrete, number, part
from jaxbeam.control.estimation.crossing_filter import ContinuousWithVehicles, SampledWithVehicles
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.model.modal_model import assemble_modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.output_rows import modal_row
from jaxbeam.model.state_space import Plant, StateSpace, build_plant, state_space
from jaxbeam.runtime.arrays import Array, Module, Number, xp
from jaxbeam.runtime.compiling import compiled_if_traced

ACTUATOR_FIELDS = ("force_per_volt", "stiffness", "damping", "correction")
LOAD_FIELDS = ("mass", "speed", "entry_time")


class DesignModel(Module):
    """Parameters of actuators and loads in the design of a controller, and its number of modes.

    Each is one number for all parts that have it, or a list with one for each actuator (or load); a
    parameter left out has its value in the case. `stiffness = 0` leaves the suspension of shakers
    out of the design; `modes` keeps only the lowest modes of the beam in it.
    """

    force_per_volt: Float[Number, " *actuator"] | None = number(
        "N/V", "steady force of shakers per volt", default=None
    )
    stiffness: Float[Number, " *actuator"] | None = number(
        "N/m", "suspension of shakers and springs", NOT_NEGATIVE, default=None
    )
    damping: Float[Number, " *actuator"] | None = number(
        "N s/m", "damping of suspensions", NOT_NEGATIVE, default=None
    )
    correction: Float[Number, " *actuator"] | None = number(
        "1", "fraction of the moment of patches that reaches the beam", default=None
    )
    mass: Float[Number, " *load"] | None = number(
        "kg", "masses of loads", NOT_NEGATIVE, default=None
    )
    speed: Float[Number, " *load"] | None = number("m/s", "speeds of loads", default=None)
    entry_time: Float[Number, " *load"] | None = number(
        "s", "predicted entry times of loads", default=None
    )
    modes: int | None = count("lowest modes of the beam in the design", default=None)

    def validate(self, case: Any) -> str | None:
        """Error of these parameters in a case, as "key must ...", or None."""
        if self.modes is not None and self.modes > case.beam.modes:
            return f"modes must be at most {case.beam.modes}, the modes of the beam: raise those"
        for names, parts in ((ACTUATOR_FIELDS, case.actuators), (LOAD_FIELDS, case.loads)):
            for name in names:
                value = getattr(self, name)
                if value is None:
                    continue
                if value.shape not in ((), (len(parts),)):
                    return f"{name} must be one number or {len(parts)}, not {value.shape[0]}"
                if not any(_has_effect(part, name) for part in parts):
                    return f"{name} has no effect: no part of the case has a {name}"
        return None

    def design_plant(self, plant: Plant, coordinates: str) -> Plant:
        """Plant with the design parameters, on the modes of the given plant or the lowest."""
        case, modes = plant.case, plant.modal_model.modes
        if self.modes is not None:
            case = eqx.tree_at(lambda c: c.beam, case, _with_modes(case.beam, self.modes))
            modes = modes.lowest(self.modes)
        parts = self._with_design_values(case.actuators, ACTUATOR_FIELDS), self.design_loads(case)
        case = eqx.tree_at(lambda c: (c.actuators, c.loads), case, parts)
        built = build_plant(case, assemble_modal_model(case, modes), coordinates)
        return built if plant.commands == len(case.actuators) else built.of_driven()

    def design_loads(self, case: Any) -> tuple:
        """Loads of a case with the design parameters."""
        return self._with_design_values(case.loads, LOAD_FIELDS)

    def _with_design_values(self, parts, names) -> tuple:
        """Parts of a case with the design parameters of these names."""
        for name in names:
            value = getattr(self, name)
            if value is None:
                continue
            values = xp.broadcast_to(value, (len(parts),))
            parts = tuple(_with_value(part, name, values[i]) for i, part in enumerate(parts))
        return parts


def _with_modes(beam, mode_count):
    """Beam with its lowest modes only, and their damping ratios."""
    ratio = beam.damping_ratio
    if ratio is not None and ratio.ndim:
        ratio = ratio[:mode_count]
    return dataclasses.replace(beam, modes=mode_count, damping_ratio=ratio)


def _with_value(part, name, value):
    if not _has_effect(part, name):
        return part
    return eqx.tree_at(lambda p: getattr(p, name), part, value)


def _has_effect(part, name) -> bool:
    """Whether a part uses a parameter; a load with a table of positions has no entry time."""
    tabulated = name == "entry_time" and part.times is not None
    return getattr(part, name, None) is not None and not tabulated


class AbstractStateLaw(Module):
    """Control law fed by an estimate of the state of its plant; static laws have an empty state.

    Fields of the class hold the design; they are constant during a run.
    """

    @property
    def needs_vehicles(self) -> bool:
        """Whether the estimate must have the states of the vehicles."""
        return False

    def initial_state(self) -> Any:
        """State of the law at the start of a run."""
        return ()

    @abc.abstractmethod
    def step(
        self, state: Any, estimate: Estimate, measurement: Measurement, t: Time
    ) -> ControlStep:
        """Command for an estimate at t (s), and the next state of the law."""

    def tabulated(self, times: Float[Array, " sample"]) -> "AbstractStateLaw":
        """The law with its time-dependent matrices tabulated at the `times` of a run (s)."""
        return self


class GainLaw(AbstractStateLaw):
    """u = -K x with a constant gain K; with `feeds_back_command` x ends with the last command."""

    gain: Float[Array, "actuator column"]
    feeds_back_command: bool = eqx.field(static=True, default=False)

    def step(self, state, estimate, measurement, t):
        x = estimate.state
        if self.feeds_back_command:
            x = xp.concatenate([x, measurement.command])
        return ControlStep(-self.gain @ x, state)


class TrueState(AbstractSampledFilter, AbstractContinuousFilter):
    """Full state information: the estimate is the true state of the plant in other coordinates.

    `state_map` maps the states of the plant to those of the design plant.
    """

    state_map: Float[Array, "design_state state"]

    def update(self, state, measurement, t):
        return self.estimate(state, measurement, t), state

    def estimate(self, state, measurement, t):
        return Estimate(self.state_map @ measurement.state)

    def rates(self, state, measurement, command, t):
        return state


class StateLawState(NamedTuple):
    """States of a law and of the filter before it."""

    law: Any
    filter: Any


class SampledStateLaw(AbstractSampledLaw):
    """State law behind a filter at samples; the state holds those of the law and of the filter."""

    law: AbstractStateLaw
    filter: AbstractSampledFilter

    def initial_state(self):
        return StateLawState(self.law.initial_state(), self.filter.initial_state())

    def tabulated(self, times):
        return SampledStateLaw(self.law.tabulated(times), self.filter.tabulated(times))

    def step(self, state, measurement, t):
        law_state, filter_state = state
        estimate, filter_state = self.filter.update(filter_state, measurement, t)
        command, law_state, solved = self.law.step(law_state, estimate, measurement, t)
        return ControlStep(command, StateLawState(law_state, filter_state), solved)


class ContinuousStateLaw(AbstractContinuousLaw):
    """Static state law behind a filter in continuous time; the states are those of the filter."""

    law: AbstractStateLaw
    filter: AbstractContinuousFilter

    @property
    def state_count(self):
        return self.filter.state_count

    def command(self, state, measurement, t):
        estimate = self.filter.estimate(state, measurement, t)
        return self.law.step(self.law.initial_state(), estimate, measurement, t).command

    def rates(self, state, measurement, command, t):
        return self.filter.rates(state, measurement, command, t)


class AbstractStateController(AbstractController):
    """Settings of a law that feeds back the state of its design plant.

    The design plant is that of the case, with the parameters of the `design` model where these
    differ; its states are those of `state_space` in the chosen coordinates. Without an `estimator`
    the law receives the true state, of which a design with fewer modes receives the first ones.
    States of vehicles, where a law needs them, are those of an estimator that has them, or else
    simulated from the state of the beam and the vehicles of the case.
    """

    coordinates: str = choice(
        "coordinates of the states", "modal", "sine", default="modal", kw_only=True
    )
    design: DesignModel | None = part("design model of the plant", DesignModel, kw_only=True)
    estimator: AbstractEstimator | None = part(
        "estimator of the state", AbstractEstimator, kw_only=True
    )

    @property
    def design_depends_on_loads(self) -> bool:
        return self.estimator is not None and self.estimator.varies

    @abc.abstractmethod
    def design_state_law(self, plant: Plant, design_plant: Plant) -> AbstractStateLaw:
        """Law for runs on `plant`, designed for `design_plant`."""

    def design_plant(self, plant: Plant) -> Plant:
        """Plant that the law is designed for, in its coordinates."""
        if self.design is None:
            return build_plant(plant.case, plant.modal_model, self.coordinates)
        return self.design.design_plant(plant, self.coordinates)

    def design_loads(self, case: Case) -> tuple:
        """Loads of a case with the parameters of the design model."""
        return case.loads if self.design is None else self.design.design_loads(case)

    def design_law(self, plant):
        plant = plant.of_driven()
        design_plant = self.design_plant(plant)
        law = self.design_state_law(plant, design_plant)
        estimated = self.estimator is not None and self.estimator.has_vehicles
        simulates = law.needs_vehicles and not estimated
        if self.estimator is None:
            filter = TrueState(_design_state_map(plant, design_plant))
        elif self.period is None:
            filter = self.estimator.continuous_filter(design_plant)
        else:
            filter = self.estimator.sampled_filter(design_plant, sample_timing(self))
        if self.period is None:
            if simulates:
                filter = ContinuousWithVehicles(filter, design_plant)
            return ContinuousStateLaw(law, filter)
        if simulates:
            timing = sample_timing(self).varying(design_plant)
            filter = SampledWithVehicles(filter, design_plant, timing)
        return SampledStateLaw(law, filter)

    def breakpoints(self, case):
        """Entry and exit times (s) of the design loads, at which a continuous gain has kinks."""
        if self.period is not None or self.estimator is None:
            return None
        design_case = eqx.tree_at(lambda c: c.loads, case, self.design_loads(case))
        return np.ravel(crossing_times(design_case))

    def validate(self, case):
        stiffened = any(actuator.section_stiffening() is not None for actuator in case.actuators)
        if self.coordinates == "sine" and (
            case.beam.ends != "pinned-pinned" or case.supports or stiffened
        ):
            return (
                "coordinates must be 'modal': the modes of this beam are not sin(n pi x / L);"
                " only a uniform pinned-pinned beam without supports in between has those"
            )
        error = None if self.design is None else self.design.validate(case)
        if error is not None:
            return f"design.{error}"
        if self.period is None and self.estimator is None:
            return None
        if self.period is None and not self.estimator.continuous_time:
            return "period must be given: this estimator acts at samples only"
        error = None if self.estimator is None else self.estimator.validate(case, None)
        if error is None and all(is_concrete(leaf) for leaf in jax.tree.leaves((self, case))):
            # Concrete numbers also under differentiation.
            controller, concrete_case = jax.tree.map(
                lambda leaf: xp.asarray(concrete(leaf)),
                (dataclasses.replace(self, nominal_plant=None), case),
            )
            design_plant = _design_plant(controller, concrete_case, mesh_layout(concrete_case))
            system = design_plant.unloaded
            if self.period is not None:
                self.warn(system, case)
            error = None if self.estimator is None else self.estimator.validate(case, system)
            if error is None:
                return controller.design_error(design_plant)
        return None if error is None else f"estimator.{error}"

    def design_error(self, design_plant: Plant) -> str | None:
        """Error of these settings for a design plant, as "key must ...", or None.

        All numbers are concrete.
        """
        return None

    def warn(self, system: StateSpace, case: Case) -> None:
        """Warn of doubtful settings for the design plant without loads, before a sampled run."""

    def mode_count(self, case: Case) -> int:
        """Number of modes of the design plant."""
        design_modes = None if self.design is None else self.design.modes
        return case.beam.modes if design_modes is None else design_modes

    def state_count(self, case: Case) -> int:
        """Number of states of the design plant."""
        actuator_states = sum(
            actuator.attachment().state_matrix.shape[0] for actuator in case.actuators
        )
        return 2 * self.mode_count(case) + actuator_states


@compiled_if_traced
def _design_plant(controller: AbstractStateController, case, layout) -> Plant:
    """Design plant of a case."""
    return controller.design_plant(state_space(case, layout=layout).of_driven())


def _design_state_map(plant: Plant, design_plant: Plant) -> Float[Array, "design_state state"]:
    """Map from the states of a plant to those of its design plant: first modes, then actuators."""
    modal_states = 2 * plant.coordinate_scale.shape[0]
    design_modal_states = 2 * design_plant.coordinate_scale.shape[0]
    states = plant.to_modal(xp.eye(plant.modal_model.state_count))
    return design_plant.from_modal(
        xp.concatenate([states[:design_modal_states], states[modal_states:]])
    )


def deflection_rows(
    plant: Plant, positions: Float[Array, " position"]
) -> Float[Array, "position state"]:
    """Rows that map the states of a plant to the deflections at positions (m)."""
    rows = modal_row(plant.modal_model.fields, plant.case, positions, "deflection")
    rows = rows / plant.coordinate_scale
    return xp.pad(rows, ((0, 0), (0, plant.modal_model.state_count - rows.shape[1])))


class StateFeedback(AbstractStateController):
    """u = -K z with the state z, in the order and units of `state_space(case, coordinates)`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.StateFeedback(gain=[[3e3, 30.0]], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.149 mm
    """

    kind: ClassVar[str] = "state"

    gain: Float[Number, "actuator state"] = number(
        "unit of a command per state", "gain, a row for each actuator"
    )

    def validate(self, case):
        shape = (len(case.driven), self.state_count(case))
        if self.gain.shape != shape:
            return f"gain must have a row for each actuator, a column for each state: {shape}"
        return super().validate(case)

    def design_state_law(self, plant, design_plant):
        return GainLaw(self.gain)

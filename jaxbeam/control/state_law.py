"""What all laws share that feed back the state: a model they are designed for, an estimator."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.estimator import AbstractEstimator, Estimate
from jaxbeam.case.fields import choice, concrete, is_concrete, part
from jaxbeam.case.loads import trajectory
from jaxbeam.control.design_model import DesignModel
from jaxbeam.estimation import KINDS
from jaxbeam.estimation.continuous import ContinuousEstimator
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import Plant, StateSpace, build_plant, state_space
from jaxbeam.runtime.compiling import compiled


class AbstractStateLaw(AbstractController):
    """A law fed by the state of the model it is designed for, true or estimated.

    The model is the case itself, or what `design` says differs from it; its states are those of
    `state_space` in the chosen coordinates. Without an `estimator` the law is given the true
    state, of which a design with fewer modes sees the first ones.
    """

    coordinates: str = choice(
        "coordinates of the states", "modal", "sine", default="modal", kw_only=True
    )
    design: DesignModel | None = part("what is believed of the plant", DesignModel, kw_only=True)
    estimator: AbstractEstimator | None = part("what estimates the state", KINDS, kw_only=True)

    @property
    def stateless(self) -> bool:
        return self.estimator is None or self.estimator.continuous_time

    @abc.abstractmethod
    def prepare(self, plant: Plant, design_plant: Plant) -> Any:
        """Memory of the law at the start of a run on `plant`, designed for `design_plant`."""

    @abc.abstractmethod
    def command(self, memory: Any, estimate: Estimate, measurement, t) -> tuple[Any, Any]:
        """Commands at time t (s) for an estimate of the state, and the memory after it."""

    def design_plant(self, plant: Plant) -> Plant:
        """The model that the law is designed for, in its coordinates."""
        if self.design is None:
            return build_plant(plant.case, plant.modal_model, self.coordinates)
        return self.design.design_plant(plant, self.coordinates)

    def init(self, plant):
        design_plant = self.design_plant(plant)
        law = self.prepare(plant, design_plant)
        if self.estimator is None:
            return law, _design_state_map(plant, design_plant)
        return law, self.estimator.init(design_plant)

    def step(self, memory, measurement, t):
        law, estimator_memory = memory
        if self.estimator is None:
            estimate = Estimate(estimator_memory @ measurement.state)
        else:
            estimate, estimator_memory = self.estimator.step(estimator_memory, measurement, t)
        command, law = self.command(law, estimate, measurement, t)
        return command, (law, estimator_memory)

    def own_states(self, memory):
        estimator_memory = memory[1]
        return (
            estimator_memory.initial_state.shape[0]
            if isinstance(estimator_memory, ContinuousEstimator)
            else 0
        )

    def flow(self, memory, states, measurement, t, saturate):
        law, estimator = memory
        if not isinstance(estimator, ContinuousEstimator):
            return super().flow(memory, states, measurement, t, saturate)
        command = saturate(self.command(law, estimator.estimate(states, t), measurement, t)[0])
        return command, estimator.rates(states, measurement.readings, command, t)

    def breakpoints(self, case):
        """At every instant, an estimator's gain bends where loads are believed to come and go."""
        if self.period is not None or self.estimator is None:
            return None
        loads = case.loads if self.design is None else self.design.design_loads(case)
        return np.ravel(
            [concrete(trajectory(load, case.beam.length).entry_exit_times()) for load in loads]
        )

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
        if self.period is None and not self.stateless:
            return "period must be given: this estimator steps from sample to sample"
        if self.period is None and self.estimator is None:
            return None
        error = None if self.estimator is None else self.estimator.validate(case, None)
        if error is None and all(is_concrete(leaf) for leaf in jax.tree.leaves((self, case))):
            law, concrete_case = jax.tree.map(
                lambda leaf: jnp.asarray(concrete(leaf)), (self, case)
            )
            system = _unloaded_design_plant(law, concrete_case, mesh_layout(concrete_case))
            if self.period is not None:
                self.warn(system, case)
            error = None if self.estimator is None else self.estimator.validate(case, system)
        return None if error is None else f"estimator.{error}"

    def warn(self, system: StateSpace, case: Any) -> None:
        """Warn of what may go wrong on the plant it is designed for, before a sampled run."""

    def mode_count(self, case: Any) -> int:
        """How many modes the law is designed for."""
        design_modes = None if self.design is None else self.design.modes
        return case.beam.modes if design_modes is None else design_modes

    def state_count(self, case: Any) -> int:
        """How many states the law is fed."""
        actuator_states = sum(
            actuator.attachment().state_matrix.shape[0] for actuator in case.actuators
        )
        return 2 * self.mode_count(case) + actuator_states


@compiled
def _unloaded_design_plant(law: AbstractStateLaw, case, layout) -> StateSpace:
    """What the law is designed for, without loads."""
    return law.design_plant(state_space(case, layout=layout)).unloaded


def _design_state_map(plant: Plant, design_plant: Plant):
    """The states of the design for the states of the plant: all of them, or those it has."""
    modal = 2 * plant.coordinate_scale.shape[0]
    kept = 2 * design_plant.coordinate_scale.shape[0]
    states = plant.to_modal(jnp.eye(plant.modal_model.state_count))
    return design_plant.from_modal(jnp.concatenate([states[:kept], states[modal:]]))

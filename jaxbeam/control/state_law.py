"""What all laws share that feed back the state: a model they are designed for, an estimator."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.estimator import AbstractEstimator, Estimate
from jaxbeam.case.fields import choice, is_known, known, part
from jaxbeam.case.loads import motion
from jaxbeam.control.design_model import Beliefs
from jaxbeam.estimation import KINDS
from jaxbeam.estimation.continuous import Flowing
from jaxbeam.model.modes import lay_out
from jaxbeam.model.state_space import LoadedBeam, StateSpace, loaded_beam, state_space
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
    design: Beliefs | None = part("what is believed of the plant", Beliefs, kw_only=True)
    estimator: AbstractEstimator | None = part("what estimates the state", KINDS, kw_only=True)

    @property
    def memoryless(self) -> bool:
        return self.estimator is None or self.estimator.flows

    @abc.abstractmethod
    def prepare(self, model: LoadedBeam, designed: LoadedBeam) -> Any:
        """Memory of the law at the start of a run on `model`, designed for `designed`."""

    @abc.abstractmethod
    def command(self, memory: Any, estimate: Estimate, measurement, t) -> tuple[Any, Any]:
        """Commands at time t (s) for an estimate of the state, and the memory after it."""

    def believed(self, model: LoadedBeam) -> LoadedBeam:
        """The model that the law is designed for, in its coordinates."""
        if self.design is None:
            return loaded_beam(model.case, model.rig, self.coordinates)
        return self.design.applied(model, self.coordinates)

    def init(self, model):
        designed = self.believed(model)
        law = self.prepare(model, designed)
        if self.estimator is None:
            return law, _seen(model, designed)
        return law, self.estimator.init(designed)

    def step(self, memory, measurement, t):
        law, own = memory
        if self.estimator is None:
            estimate = Estimate(own @ measurement.state)
        else:
            estimate, own = self.estimator.step(own, measurement, t)
        wanted, law = self.command(law, estimate, measurement, t)
        return wanted, (law, own)

    def own_states(self, memory):
        own = memory[1]
        return own.start.shape[0] if isinstance(own, Flowing) else 0

    def flow(self, memory, own, measurement, t, limited):
        law, flowing = memory
        if not isinstance(flowing, Flowing):
            return super().flow(memory, own, measurement, t, limited)
        command = limited(self.command(law, flowing.estimate(own, t), measurement, t)[0])
        return command, flowing.rates(own, measurement.readings, command, t)

    def knots(self, case):
        """At every instant, an estimator's gain bends where loads are believed to come and go."""
        if self.period is not None or self.estimator is None:
            return None
        loads = case.loads if self.design is None else self.design.loads(case)
        return np.ravel([known(motion(load, case.beam.length).window()) for load in loads])

    def fault(self, case):
        bonded = any(actuator.bonded() is not None for actuator in case.actuators)
        if self.coordinates == "sine" and (
            case.beam.ends != "pinned-pinned" or case.supports or bonded
        ):
            return (
                "coordinates must be 'modal': the modes of this beam are not sin(n pi x / L);"
                " only a uniform pinned-pinned beam without supports in between has those"
            )
        fault = None if self.design is None else self.design.fault(case)
        if fault is not None:
            return f"design.{fault}"
        if self.period is None and not self.memoryless:
            return "period must be given: this estimator steps from sample to sample"
        if self.period is None and self.estimator is None:
            return None
        fault = None if self.estimator is None else self.estimator.fault(case, None)
        if fault is None and all(is_known(leaf) for leaf in jax.tree.leaves((self, case))):
            law, plain = jax.tree.map(lambda leaf: jnp.asarray(known(leaf)), (self, case))
            plant = _plant(law, plain, lay_out(plain))
            if self.period is not None:
                self.look_at(plant, case)
            fault = None if self.estimator is None else self.estimator.fault(case, plant)
        return None if fault is None else f"estimator.{fault}"

    def look_at(self, plant: StateSpace, case: Any) -> None:
        """Warn of what may go wrong on the plant it is designed for, before a sampled run."""

    def modes(self, case: Any) -> int:
        """How many modes the law is designed for."""
        known = None if self.design is None else self.design.modes
        return case.beam.modes if known is None else known

    def states(self, case: Any) -> int:
        """How many states the law is fed."""
        own = sum(actuator.attachment().state_matrix.shape[0] for actuator in case.actuators)
        return 2 * self.modes(case) + own


@compiled
def _plant(law: AbstractStateLaw, case, layout) -> StateSpace:
    """What the law is designed for, without loads."""
    return law.believed(state_space(case, layout=layout)).unloaded


def _seen(model: LoadedBeam, designed: LoadedBeam):
    """The states of the design for the states of the plant: all of them, or those it has."""
    modal = 2 * model.scale.shape[0]
    kept = 2 * designed.scale.shape[0]
    states = model.to_rig(jnp.eye(model.rig.states))
    return designed.from_rig(jnp.concatenate([states[:kept], states[modal:]]))

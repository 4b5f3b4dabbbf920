"""Predictive control over scenarios: one sequence of commands for several plants and loads.

Source: Calafiore and Campi, IEEE Trans. Automatic Control 51, 2006; here scenarios are given, not
drawn.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, concrete, is_concrete, number
from jaxbeam.control.mpc import MPC, MPCLaw, rows_within
from jaxbeam.control.state_controller import AbstractStateLaw
from jaxbeam.model.modal_model import assemble_modal_model
from jaxbeam.model.state_space import Plant, build_plant
from jaxbeam.numerics.qp import QuadraticProgram, first_move
from jaxbeam.runtime.arrays import Array, Number, xp


class ScenarioMPC(MPC):
    """Model predictive control of several plants and loads by one sequence of commands.

    Scenario i has the design plant with the stiffness of its beam and supports times
    `stiffness_factors[i]`, masses (and weights) of the loads times `mass_factors[i]` and the delay
    `delays[i]`; one number holds in all scenarios, and what is left out is that of the design.
    Damping ratios stay. Each scenario explains the present state by an unexplained change of its
    own. Limits of commands, and the `hard_limit` and `soft_limit` in every scenario, belong to one
    quadratic program, whose objective is that of `MPC`, the "mean" over the scenarios, or, with the
    "worst", horizon times the square of the largest predicted deflection, weighted by the roots of
    its weights, of any scenario, period and position, and the cost of the moves.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.ScenarioMPC(
    ...         horizon=4,
    ...         moves=2,
    ...         move_weight=1e-9,
    ...         period=0.005,
    ...         stiffness_factors=[0.8, 1.0, 1.2],
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.090 mm
    """

    kind: ClassVar[str] = "mpc-scenario"

    stiffness_factors: Float[Number, " *scenario"] = number(
        "1", "stiffness of the beam over that of the design", POSITIVE, default=1.0
    )
    mass_factors: Float[Number, " *scenario"] = number(
        "1", "masses of the loads over those of the design", POSITIVE, default=1.0
    )
    delays: Float[Number, " *scenario"] | None = number(
        "s", "from measurement to command", NOT_NEGATIVE, default=None
    )
    merit: str = choice("merit over the scenarios", "mean", "worst", default="mean")

    @property
    def scenario_count(self) -> int:
        """Number of scenarios."""
        return max(
            [part.shape[0] for part in self._parts() if part is not None and part.ndim], default=1
        )

    def _parts(self):
        return self.stiffness_factors, self.mass_factors, self.delays

    def validate(self, case):
        names, count = ("stiffness_factors", "mass_factors", "delays"), self.scenario_count
        for name, part in zip(names, self._parts(), strict=True):
            if part is not None and part.shape not in ((), (count,)):
                return f"{name} must be one number or {count}, as the others, not {part.size}"
        times = self.delays, self.period
        if all(part is not None and is_concrete(part) for part in times):
            delays, period = map(concrete, times)
            if np.max(delays) >= period:
                return "delays must be less than the period: there is one pending command"
        if self.mass_factors.ndim and self.loads == "ignored":
            if self.prediction == "time-invariant":
                return "mass_factors must be left out: the prediction has no loads"
            if not case.loads:
                return "mass_factors must be left out: there are no loads"
        if self.mass_factors.ndim and any(getattr(x, "mass", None) is None for x in case.loads):
            return "mass_factors must be left out: they are for loads with one mass"
        if self.terminal == "dual-mode":
            return "terminal must be 'none' or 'riccati': no set serves all scenarios"
        if self.merit == "worst" and self.terminal != "none":
            return "terminal must be 'none' with the merit 'worst', which has no cost beyond it"
        if self.merit == "worst" and self.solver == "unconstrained":
            return "solver must not be 'unconstrained' with the merit 'worst', a matter of limits"
        return super().validate(case)

    def design_state_law(self, plant, design_plant):
        count = self.scenario_count
        stiffness, masses = (
            xp.broadcast_to(part, (count,)) for part in (self.stiffness_factors, self.mass_factors)
        )
        delays = None if self.delays is None else xp.broadcast_to(self.delays, (count,))
        laws = []
        for i in range(count):
            settings = self if delays is None else dataclasses.replace(self, delay=delays[i])
            scenario = self._scenario(design_plant, stiffness[i], masses[i])
            laws.append(MPC.design_state_law(settings, plant, scenario))
        return ScenarioLaw(tuple(laws), masses, self.merit == "worst")

    def _scenario(self, design_plant: Plant, stiffness, mass) -> Plant:
        """Design plant with other stiffness and masses of loads; the shapes of its modes stay."""
        case, modes = design_plant.case, design_plant.modal_model.modes
        root = xp.sqrt(stiffness)
        modes = eqx.tree_at(
            lambda m: (m.stiffness, m.coupling, m.stiffness_unit, m.damping, m.damping_coupling),
            modes,
            (
                *(part * stiffness for part in (modes.stiffness, modes.coupling)),
                modes.stiffness_unit * stiffness,
                *(part * root for part in (modes.damping, modes.damping_coupling)),
            ),
        )
        if self.mass_factors.ndim:
            loads = [eqx.tree_at(lambda x: x.mass, x, x.mass * mass) for x in case.loads]
            case = eqx.tree_at(lambda c: c.loads, case, tuple(loads))
        return build_plant(case, assemble_modal_model(case, modes), self.coordinates).of_driven()


class ScenarioLaw(AbstractStateLaw):
    """Law of several scenarios, each with the predictive law of its plant.

    `mass_factors` are those of estimated weights; with `worst` the largest deflection counts.
    """

    laws: tuple[MPCLaw, ...]
    mass_factors: Float[Array, " scenario"]
    worst: bool = eqx.field(static=True)

    @property
    def needs_vehicles(self):
        return self.laws[0].needs_vehicles

    def initial_state(self):
        return self.laws[0].initial_state()

    def tabulated(self, times):
        return dataclasses.replace(self, laws=tuple(law.tabulated(times) for law in self.laws))

    def step(self, state, estimate, measurement, t):
        command, parts, after = measurement.command, [], state
        for law, factor in zip(self.laws, self.mass_factors, strict=True):
            weights = estimate.weights
            weights = None if weights is None else weights * factor
            own = estimate._replace(weights=weights)
            prediction, initial, after = law.conditions(state, own, command, t)
            parts.append((law, prediction, initial))
        first = self.laws[0]
        move, solved = first_move(
            self.quadratic_program(parts, command), first.move_maps, first.solver
        )
        return ControlStep(command + xp.where(solved, move, 0.0), after, solved)

    def quadratic_program(self, parts, command) -> QuadraticProgram:
        """Quadratic program of all scenarios, from the law, prediction and conditions of each."""
        first, weight = self.laws[0], 1 / len(parts)
        if self.worst:
            H = first.move_cost()
            program = first.of_moves(H, xp.zeros(H.shape[0]), command)
        else:
            merits = [law.merit(prediction, initial) for law, prediction, initial in parts]
            H, f = (weight * sum(terms[1:], terms[0]) for terms in zip(*merits, strict=True))
            program = first.of_moves(H, f, command)
        if first.solver == "unconstrained":
            return program._replace(M=program.M[:0], gamma=program.gamma[:0])
        for law, prediction, initial in parts:
            program = law.limited(program, prediction, initial, weight)
        if not self.worst:
            return program
        rows, sides = [], []
        for law, prediction, initial in parts:
            roots = xp.sqrt(law.output_weights)
            free = roots * (prediction.F @ initial)
            own_rows, own_sides = rows_within(roots[..., None] * prediction.Phi, free, xp.zeros(()))
            rows.append(own_rows)
            sides.append(own_sides)
        rows, sides = xp.concatenate(rows), xp.concatenate(sides)
        cost = xp.full(1, float(first.move_maps.shape[0]))
        return program.softly_within(rows, sides, xp.ones((rows.shape[0], 1)), cost)

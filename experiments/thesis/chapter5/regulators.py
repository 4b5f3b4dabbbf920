"""The regulators of chapter 5 on rig A, and runs under them, by interpretations of the shaker.

Gains are designed for 4.6 N/V and 12000 N/m as printed, and q1, q2 and the rate of q1 are fed back.
The shaker of the plant is interpreted in several ways, one of which is the thesis's own
electromechanical model instead of the first-order one.
"""

import dataclasses
from typing import NamedTuple

import jaxbeam as jb
from experiments.thesis.cases import data_physics_v4, plan_with_steps
from experiments.thesis.chapter5.regulator_limits import (
    OTHER_FORCE,
    OTHER_SHAKER,
    TimeVaryingLoops,
    with_other_shaker,
)
from experiments.thesis.verdicts import LITERAL
from jaxbeam.case.controller import AbstractController
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.model.modes import mesh_layout
from jaxbeam.simulation.integration_plan import IntegrationPlan

MASSES, SPEEDS = (0.261, 0.371, 0.509), (0.3, 0.55)  # kg, m/s
STATE_WEIGHTS = [1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0]  # of q, its rate, and the shaker
COMMAND_WEIGHT = 9e-5  # R
PRINTED_STATES = [1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0]  # fraction of each state that is fed back
ALL_STATES, FIRST_MODE = [1.0] * 7, [1.0, 0, 0, 0, 0, 0, 0]
STEPS_PER_SAMPLE = {jb.Shaker: 1, jb.Electrodynamic: 2}
SENSOR = 1  # at 0.25 m
NO_CONTROL = "no control"
LAWS = {
    "time-invariant": {},
    "time-varying": {"horizon": "crossing"},
    "augmented": {"horizon": "crossing", "augmented": "loads"},
}


class RegulatorInterpretation(NamedTuple):
    """Interpretation of the printed regulator: plant, command weight, and states fed back.

    `force_per_volt` (N/V) and `stiffness` (N/m) are those of the plant's shaker. The law is
    designed for `design_force` (N/V), on the rig of `with_other_shaker` if `other` is set.
    """

    force_per_volt: float
    command_weight: float
    stiffness: float
    feedback: list[float]
    design_force: float = 4.6
    other: bool = False


WEAK_SHAKER = "2.5 N/V reach the beam"
OTHER_WEIGHT = "R = 5e-4, 3500 N/m, all states"
INTERPRETATIONS = {
    LITERAL: RegulatorInterpretation(4.6, COMMAND_WEIGHT, 12000.0, PRINTED_STATES),
    WEAK_SHAKER: RegulatorInterpretation(2.5, COMMAND_WEIGHT, 12000.0, PRINTED_STATES),
    OTHER_WEIGHT: RegulatorInterpretation(4.6, 5e-4, 3500.0, ALL_STATES),
    OTHER_SHAKER: RegulatorInterpretation(
        OTHER_FORCE, COMMAND_WEIGHT, 12000.0, PRINTED_STATES, OTHER_FORCE, True
    ),
    f"{OTHER_SHAKER}; {WEAK_SHAKER}": RegulatorInterpretation(
        2.5, COMMAND_WEIGHT, 12000.0, PRINTED_STATES, OTHER_FORCE, True
    ),
}
FULL_SHAKER = "full model of the shaker, Table 2.3"
REFITTED_SHAKER = "full model, 12000 N/m and 80 N s/m with its back-EMF"


def regulator(
    kind: str,
    command_weight: float,
    feedback,
    damping: float | None = None,
    design_force: float = 4.6,
) -> AbstractController:
    """A regulator of chapter 5, designed for a force per volt (N/V).

    `kind` is a key of LAWS, `feedback` the fraction of each state that is fed back, and `damping`
    (N s/m) that of the suspension in the design, as in the plant if left out.
    """
    return jb.LQR(
        **LAWS[kind],
        state_weight=STATE_WEIGHTS,
        command_weight=[command_weight],
        feedback=feedback,
        coordinates="sine",
        design=DesignModel(force_per_volt=design_force, damping=damping),
    )


def interpreted_rigs(rig: jb.Case) -> dict[str, jb.Case]:
    """Rig A with the shaker of each interpretation."""
    return {
        name: jb.replace(
            with_other_shaker(rig) if one.other else rig,
            {
                "actuators.0.force_per_volt": one.force_per_volt,
                "actuators.0.stiffness": one.stiffness,
            },
        )
        for name, one in INTERPRETATIONS.items()
    }


def electromechanical_shakers(rig: jb.Case) -> dict[str, jb.Electrodynamic]:
    """The electrodynamic shaker as in Table 2.3, and on the suspension fitted to rig A."""
    shaker, passive = data_physics_v4(), rig.actuators[0]
    back_emf_damping = shaker.force_constant * shaker.back_emf / shaker.resistance  # N s/m
    damping = passive.damping - back_emf_damping
    refitted = dataclasses.replace(shaker, stiffness=passive.stiffness, damping=damping)
    return {FULL_SHAKER: shaker, REFITTED_SHAKER: refitted}


def time_varying_loops(
    case: jb.Case, one: RegulatorInterpretation, damping: float | None = None
) -> TimeVaryingLoops:
    """The loop under the time-varying regulator, with some states fed back and with all.

    `damping` (N s/m) is that of the suspension in the design.
    """
    laws = (
        regulator("time-varying", one.command_weight, feedback, damping, one.design_force)
        for feedback in (PRINTED_STATES, ALL_STATES)
    )
    return TimeVaryingLoops(*(dataclasses.replace(case, controller=law) for law in laws))


class RegulatorRuns:
    """Runs under the regulators; the time step is chosen once for each law and kind of shaker.

    `records` has those with the states that an interpretation feeds back, by interpretation, law,
    speed (m/s) and mass (kg).
    """

    def __init__(self, rig: jb.Case):
        self.layout, self.plans, self.records = mesh_layout(rig), {}, {}

    def peak(
        self, name, design, actuator, kind, speed, mass, feedback=None, design_mass=None
    ) -> float:
        """Largest deflection (m) at 0.25 m under a law designed for one case, on another shaker.

        `name` is the interpretation, `kind` a key of LAWS or NO_CONTROL. `feedback` is the fraction
        of each state that is fed back, `design_mass` (kg) the load that the law is designed for.
        """
        design = jb.replace(design, {"loads.0.mass": mass, "loads.0.speed": speed})
        plant = dataclasses.replace(design, actuators=(actuator,))
        if kind in LAWS:
            interpretation = INTERPRETATIONS.get(name, INTERPRETATIONS[LITERAL])
            states = interpretation.feedback if feedback is None else feedback
            law = regulator(
                kind,
                interpretation.command_weight,
                states,
                design_force=interpretation.design_force,
            )
            changes = {} if design_mass is None else {"loads.0.mass": design_mass}
            nominal = dataclasses.replace(jb.replace(design, changes), controller=law)
            nominal_plant = jb.state_space(nominal, layout=self.layout)
            law = dataclasses.replace(law, nominal_plant=nominal_plant)
            plant = dataclasses.replace(plant, controller=law)
        key = kind, type(actuator)
        if key not in self.plans:
            self.plans[key] = _regulated_plan(plant)
        record = jb.simulate(plant, plan=self.plans[key])
        if feedback is None and design_mass is None:
            self.records[name, kind, speed, mass] = record
        return float(record.peak_deflection[SENSOR])


def _regulated_plan(case: jb.Case) -> IntegrationPlan:
    """Integration plan of a run, with the steps of its shaker in each sample.

    Far fewer than the search takes for the time constant of a coil, which it follows, though the
    steps are exact for the shaker: peaks of bounded loops differ by 4e-8 at most from those with
    two and three times as many.
    """
    steps = STEPS_PER_SAMPLE[type(case.actuators[0])]
    plan = plan_with_steps(case, steps)
    return dataclasses.replace(plan, substeps=steps)

"""Plant and loop of a case as objects of python-control, with a stationary mass on the beam."""

import dataclasses
from typing import Any, NamedTuple

from jaxbeam.analysis.stationary_loop import loop_with_mass_at, standing_mass
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.loads.point import MovingMass
from jaxbeam.case.validation import check_case
from jaxbeam.model.state_space import state_space


class ControlSystems(NamedTuple):
    """Systems of python-control, `control.StateSpace`, with named signals.

    `plant` is in continuous time, from the commands `command_i` and, with a mass on the beam, its
    weight `load_0` (N, positive downwards) to the readings `sensor_i_<quantity>` of ideal sensors.
    `loop` is opened at the commands: from those that act, `command_i`, to those that the law
    returns, `law_i`, with filters, estimators and delays, in discrete time where the law samples.
    `closed` is the closed loop, from commands added to those of the law to those of the law. Both
    are None for a case without a controller.
    """

    plant: Any
    loop: Any
    closed: Any


@refuses_traced("a system of python-control")
def to_control(
    case: Case, position: float | None = None, mass: float | None = None
) -> ControlSystems:
    """Plant and loop of a case as objects of python-control.

    A stationary `mass` (kg), that of the first load of the case if left out, is at `position` (m);
    without a position there is none. Nonlinear laws are linearised about the equilibrium under the
    mass, schedules have the gains of the time at which the first load is there.

    Raises ValueError for an invalid case, a mass without a position, a position off the beam, and a
    mass that is negative or missing; ImportError, saying what to install, if python-control is
    missing.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ...     controller=jb.Feedback([200.0], period=0.002),
    ... )
    >>> systems = jb.to_control(case, position=0.3)
    >>> systems.plant.input_labels, systems.plant.output_labels, systems.loop.dt
    (['command_0', 'load_0'], ['sensor_0_deflection'], 0.002)
    """
    check_case(case)
    if position is None and mass is not None:
        raise ValueError("mass needs a position (m) of the mass on the beam")
    if position is not None and mass is None:
        mass = _first_mass(case)
    plant = state_space(case)
    if position is None or mass is None:
        system, position, mass = plant.unloaded, float(concrete(case.beam.length)) / 2, 0.0
    else:
        loads = standing_mass(case, position, mass)
        alone = dataclasses.replace(case, loads=(MovingMass(mass=mass, speed=1.0),), profile=None)
        system = dataclasses.replace(plant, case=alone, loads=loads).at(0.0)
    if case.controller is None:
        return ControlSystems(system.to_control(), None, None)
    loop = loop_with_mass_at(case, position, mass)
    return ControlSystems(system.to_control(), loop.to_control(), loop.closed_to_control())


def _first_mass(case: Case) -> float:
    """Mass (kg) of the first load of a case."""
    mass = case.loads[0].total_mass(case.run.gravity) if case.loads else None
    if mass is None:
        raise ValueError("mass must be given: the case has no load with a mass")
    return float(concrete(mass))

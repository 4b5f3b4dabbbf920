"""Design model: plant parameters of the design of a controller where they differ from the case."""

import dataclasses
from typing import Any

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, count, number
from jaxbeam.model.modal_model import assemble_modal_model
from jaxbeam.model.state_space import Plant, build_plant
from jaxbeam.runtime.arrays import Number, xp
from jaxbeam.runtime.module import Module

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

"""A case in the words of the independent finite-element oracle."""

from jaxbeam.case.case import Case
from tests.oracles import finite_elements


def as_oracle(case: Case, elements: int = 40) -> finite_elements.Beam:
    """The beam of a case with its supports, bonded patches and suspensions, loads left out."""
    bonded = [b for b in (actuator.bonded() for actuator in case.actuators) if b is not None]
    hung = [(a.stroke(), a.attachment()) for a in case.actuators]
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
        float(case.beam.rigidity),
        float(case.beam.linear_density),
        case.beam.ends,
        supports,
        [
            finite_elements.Patch(float(b.start), float(b.end), float(b.rigidity), float(b.mass))
            for b in bonded
        ],
        [
            finite_elements.Suspension(float(stroke[0][0]), float(a.stiffness), float(a.damping))
            for stroke, a in hung
            if len(stroke) == 1 and stroke[0][1] == 0
        ],
        elements=elements,
    )

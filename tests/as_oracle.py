"""Cases as models of the independent finite-element oracle."""

from jaxbeam.case.case import Case
from tests.oracles import finite_elements


def as_oracle(case: Case, elements: int = 40) -> finite_elements.Beam:
    """Finite-element beam of a case with supports, patches and suspensions, without loads."""
    stiffenings = [
        b for b in (actuator.section_stiffening() for actuator in case.actuators) if b is not None
    ]
    attachments = [(a.displacement_map(), a.attachment()) for a in case.actuators]
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
        float(case.beam.bending_stiffness),
        float(case.beam.linear_density),
        case.beam.ends,
        supports,
        [
            finite_elements.Patch(
                float(b.start), float(b.end), float(b.bending_stiffness), float(b.mass_per_length)
            )
            for b in stiffenings
        ],
        [
            finite_elements.Suspension(
                float(displacement_map[0][0]), float(a.stiffness), float(a.damping)
            )
            for displacement_map, a in attachments
            if len(displacement_map) == 1 and displacement_map[0][1] == 0
        ],
        elements=elements,
    )

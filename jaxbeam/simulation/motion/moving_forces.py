"""Motion of a beam under forces at constant speeds, in closed form."""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.integrator.forces.paths import constant_speeds, force_paths, force_wheels
from jaxbeam.integrator.forces.states import outputs_of_forces
from jaxbeam.integrator.forces.system import force_system
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.corrected_rows import LinearOutputs
from jaxbeam.model.static_correction import Motion
from jaxbeam.simulation.motion.at_samples import motion_at


def motion_of_forces(
    case: Case, model: ModalModel, loads: LoadSet, times: Float[np.ndarray, " time"]
) -> Motion | None:
    """Motion of a run without controller at times (s); None if it is not of the kind.

    All loads have to be forces that move at constant speeds, and the poles of the beam distinct.
    Forces off the beam are left out of the motion.
    """
    if not constant_speeds(loads):
        return None
    states = LinearOutputs(np.eye(model.state_count), None)
    system = force_system(model, states, np.zeros(0))
    if system is None:
        return None
    paths = force_paths(case, force_wheels(case), (), np.zeros((1, 0)))
    found = outputs_of_forces(system, paths, times)
    motion = motion_at(case, model, loads, times, found[..., None], None)[0]
    # Only as many columns as there are forces on the beam at once.
    off_beam = ~np.isfinite(motion.load_position)
    most = int((~off_beam).sum(axis=1).max(initial=0))
    on_beam = np.argsort(off_beam, axis=1, kind="stable")[:, :most]
    position, force = (
        np.take_along_axis(np.asarray(part), on_beam, axis=1)
        for part in (motion.load_position, motion.contact_force)
    )
    return motion._replace(load_position=position, contact_force=force)

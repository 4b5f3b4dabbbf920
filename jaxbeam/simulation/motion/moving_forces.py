"""Motion of a beam under forces at constant speeds, in closed form."""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.integrator.forces.paths import constant_speeds, force_paths
from jaxbeam.integrator.forces.states import outputs_of_forces
from jaxbeam.integrator.forces.system import force_system
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling, modal_model
from jaxbeam.model.modes import Modes, mesh_layout
from jaxbeam.model.sensing.linear_outputs import LinearOutputs
from jaxbeam.model.static_correction import Motion
from jaxbeam.simulation.motion.at_samples import motion_at


def motion_of_forces(case: Case, times: Float[np.ndarray, " time"]) -> tuple[Modes, Motion] | None:
    """Modes, and motion of a run without controller at times (s); None if it is not of the kind.

    All loads have to be forces that move at constant speeds, and the poles of the beam distinct.
    Forces off the beam are left out of the motion.
    """
    loads = load_set(case)
    if not constant_speeds(loads):
        return None
    model = modal_model(case, mesh_layout(case), has_coupling(case))
    states = LinearOutputs(np.eye(model.state_count), None)
    system = force_system(model, states, np.zeros(0))
    if system is None:
        return None
    found = outputs_of_forces(system, force_paths(case, (), np.zeros((1, 0))), times)
    motion = motion_at(case, model, loads, times, found[..., None], None)[0]
    # Only as many columns as there are forces on the beam at once.
    off_beam = ~np.isfinite(motion.load_position)
    most = int((~off_beam).sum(axis=1).max(initial=0))
    on_beam = np.argsort(off_beam, axis=1, kind="stable")[:, :most]
    position, force = (
        np.take_along_axis(np.asarray(part), on_beam, axis=1)
        for part in (motion.load_position, motion.contact_force)
    )
    return model.modes, motion._replace(load_position=position, contact_force=force)

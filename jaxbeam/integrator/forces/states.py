"""States of a beam under forces at constant speeds, at any times, in closed form."""

import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.force_peaks import ForcePaths, force_panels
from jaxbeam.integrator.force_system import ForceSystem, force_responses


def outputs_of_forces(
    system: ForceSystem, paths: ForcePaths, times: Float[np.ndarray, " time"]
) -> Float[np.ndarray, "time output"]:
    """Outputs Re(C eta) of one run, from rest, at times (s); without their static parts."""
    responses = force_responses(system, np.unique(paths.speed))
    panels = force_panels(responses, paths)
    panel = np.maximum(np.searchsorted(panels.start, times, side="right") - 1, 0)
    since = (times - panels.start[panel])[:, None]
    eta = panels.amplitude[panel] * np.exp(since * system.poles)
    which, at = panels.forces_in(panel)
    piece, number = panels.piece[at], panels.response[at]
    x = panels.origin[at] + panels.speed[at] * times[which]
    x = np.clip(x, system.breaks[piece], system.breaks[piece + 1])
    segment = system.segment[piece]
    for u, s in np.unique(np.stack([number, segment]), axis=1).T.tolist():
        here = (number == u) & (segment == s)
        p = responses.particular(u, s, x[here])
        np.add.at(eta, which[here], panels.force[at][here, None] * p)
    return (eta @ system.on_outputs.T).real

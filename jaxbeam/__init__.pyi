from .analysis.amplification import (
    Envelope as Envelope,
    amplification as amplification,
    envelope as envelope,
)
from .analysis.bound.bound import bound as bound
from .analysis.static_correction import (
    bending_moment as bending_moment,
    corrected_deflection as corrected_deflection,
    shear_force as shear_force,
)
from .case.actuators import (
    Electrodynamic as Electrodynamic,
    Patch as Patch,
    PointForce as PointForce,
    Shaker as Shaker,
    SpringDamper as SpringDamper,
)
from .case.beam import Beam as Beam, Support as Support
from .case.case import Case as Case, Run as Run, addresses as addresses, replace as replace
from .case.filters import Filter as Filter
from .case.loads import MovingForce as MovingForce, MovingMass as MovingMass
from .case.sensors import Sensor as Sensor
from .control import (
    LQR as LQR,
    MPC as MPC,
    PD as PD,
    AugmentedLQR as AugmentedLQR,
    DiscreteLQR as DiscreteLQR,
    Feedback as Feedback,
    FiniteLQR as FiniteLQR,
    Lead as Lead,
    Passage as Passage,
    PositivePositionFeedback as PositivePositionFeedback,
    Prescribed as Prescribed,
    Recognition as Recognition,
    Relief as Relief,
    ScheduledFeedback as ScheduledFeedback,
    ScheduledLQR as ScheduledLQR,
    StateFeedback as StateFeedback,
    StepLQR as StepLQR,
    recognised as recognised,
    sampling_limit as sampling_limit,
)
from .estimation import (
    Inversion as Inversion,
    Kalman as Kalman,
    Observer as Observer,
)
from .files.case_file import load_case as load_case, save_case as save_case
from .model.frequency_response import (
    accelerance as accelerance,
    frequency_response as frequency_response,
    mobility as mobility,
    receptance as receptance,
)
from .model.modes import modes as modes
from .model.state_space import state_space as state_space
from .model.statics import (
    influence_line as influence_line,
    static_deflection as static_deflection,
    static_peak as static_peak,
)
from .simulation.record import Record as Record, read_record as read_record
from .simulation.simulate import simulate as simulate
from .sweeps.sweep import sweep as sweep

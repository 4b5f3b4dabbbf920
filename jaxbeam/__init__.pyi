from . import api as api, benchmark as benchmark, tuning as tuning
from .analysis import ride as ride, sections as sections
from .analysis.absorber_tuning import tuned_absorber as tuned_absorber
from .analysis.assessment.assess import assess as assess
from .analysis.bound.bound import bound as bound
from .analysis.linearised_loop import to_control as to_control
from .analysis.sections import envelope as envelope
from .case import actuators as actuators, profiles as profiles
from .case.absorbers import Absorber as Absorber
from .case.actuators.base import (
    Patch as Patch,
    PointForce as PointForce,
    Shaker as Shaker,
    SpringDamper as SpringDamper,
)
from .case.actuators.electrodynamic import Electrodynamic as Electrodynamic
from .case.beam import Beam as Beam, Hinge as Hinge, Segment as Segment, Support as Support
from .case.case import Case as Case, Run as Run, addresses as addresses, replace as replace
from .case.contact import (
    BilateralContact as BilateralContact,
    UnilateralContact as UnilateralContact,
)
from .case.loads import vehicles as vehicles
from .case.loads.axles import Axles as Axles, LineLoad as LineLoad
from .case.loads.base import (
    MovingForce as MovingForce,
    MovingMass as MovingMass,
    VaryingForce as VaryingForce,
)
from .case.loads.vehicles import Oscillator as Oscillator, QuarterCar as QuarterCar
from .case.loads.walking import Crowd as Crowd, Pedestrian as Pedestrian
from .case.sensors import Filter as Filter, Sensor as Sensor
from .case.track import Track as Track
from .control import receptance_method as receptance_method
from .control.compensators import PD as PD, PositivePositionFeedback as PositivePositionFeedback
from .control.estimation.inversion import Inversion as Inversion
from .control.estimation.kalman import ExtendedKalman as ExtendedKalman, Kalman as Kalman
from .control.estimation.moving_horizon import MovingHorizon as MovingHorizon
from .control.estimation.observer import Observer as Observer
from .control.feedback import (
    Feedback as Feedback,
    OutputFeedback as OutputFeedback,
    ScheduledFeedback as ScheduledFeedback,
)
from .control.feedforward import Feedforward as Feedforward, Prescribed as Prescribed
from .control.gpc import GPC as GPC, AdaptiveGPC as AdaptiveGPC
from .control.h_infinity import HInfinity as HInfinity
from .control.internal_model import (
    InternalModel as InternalModel,
    ScheduledInternalModel as ScheduledInternalModel,
)
from .control.load_identification import LoadIdentification as LoadIdentification
from .control.lqr import LQR as LQR
from .control.mpc import MPC as MPC
from .control.scenario_mpc import ScenarioMPC as ScenarioMPC
from .control.semi_active import SemiActive as SemiActive
from .control.sliding_mode import SlidingMode as SlidingMode
from .control.state_controller import StateFeedback as StateFeedback
from .files.case_file import load_case as load_case, save_case as save_case
from .files.tables import save as save
from .model import frequency_responses as frequency_responses, statics as statics
from .model.frequency_responses import frequency_response as frequency_response
from .model.plausibility.check import check as check, modes as modes
from .model.state_space import state_space as state_space
from .model.statics import influence_line as influence_line
from .simulation.record import Record as Record, Result as Result
from .simulation.simulate import simulate as simulate
from .simulation.simulator import Simulator as Simulator
from .simulation.stored_record import read_record as read_record
from .simulation.sweeps.sweep import sweep as sweep

__version__: str

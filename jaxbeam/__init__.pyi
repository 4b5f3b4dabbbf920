from . import api as api, tuning as tuning
from .analysis import ride as ride, sections as sections
from .analysis.absorber_tuning import tuned_absorber as tuned_absorber
from .analysis.assessment.assess import assess as assess
from .analysis.bound.bound import bound as bound
from .analysis.bound.least_integral import least_integral as least_integral
from .analysis.control_systems import to_control as to_control
from .analysis.sections import envelope as envelope
from .case import profiles as profiles
from .case.absorbers import Absorber as Absorber
from .case.actuators.electrodynamic import (
    CurrentLoop as CurrentLoop,
    Electrodynamic as Electrodynamic,
    ForceLoop as ForceLoop,
)
from .case.actuators.hysteresis import Creep as Creep, Hysteresis as Hysteresis
from .case.actuators.patch import Patch as Patch
from .case.actuators.point import (
    PointForce as PointForce,
    Shaker as Shaker,
    SpringDamper as SpringDamper,
)
from .case.beam import (
    Beam as Beam,
    Hinge as Hinge,
    Segment as Segment,
    Support as Support,
    rayleigh_coefficients as rayleigh_coefficients,
)
from .case.case import Case as Case, Run as Run, addresses as addresses, replace as replace
from .case.filters import Filter as Filter
from .case.loads import planar as planar
from .case.loads.axles import Axles as Axles, LineLoad as LineLoad
from .case.loads.cars import (
    HalfCar as HalfCar,
    Oscillator as Oscillator,
    QuarterCar as QuarterCar,
    Wagon as Wagon,
)
from .case.loads.planar.vehicle import (
    Coach as Coach,
    TrainLoad as TrainLoad,
    VehicleLoad as VehicleLoad,
    load_vehicle as load_vehicle,
)
from .case.loads.point import (
    MovingForce as MovingForce,
    MovingMass as MovingMass,
    VaryingForce as VaryingForce,
)
from .case.loads.walking import Crowd as Crowd, Pedestrian as Pedestrian
from .case.sensors import Sensor as Sensor
from .control import receptance_method as receptance_method
from .control.compensators import PD as PD, PositivePositionFeedback as PositivePositionFeedback
from .control.feedback import (
    Feedback as Feedback,
    OutputFeedback as OutputFeedback,
    ScheduledFeedback as ScheduledFeedback,
)
from .control.feedforward import Feedforward as Feedforward, Prescribed as Prescribed
from .control.internal_model import (
    InternalModel as InternalModel,
    ScheduledInternalModel as ScheduledInternalModel,
)
from .control.load_identification import (
    LoadIdentification as LoadIdentification,
    identified_load as identified_load,
)
from .control.optimal.h_infinity import HInfinity as HInfinity
from .control.optimal.lqr import LQR as LQR
from .control.optimal.sampled_lqr import sampling_limit as sampling_limit
from .control.predictive.gpc import GPC as GPC, AdaptiveGPC as AdaptiveGPC
from .control.predictive.mpc import MPC as MPC
from .control.predictive.scenario_mpc import ScenarioMPC as ScenarioMPC
from .control.sliding_mode import SlidingMode as SlidingMode
from .control.state_controller import StateFeedback as StateFeedback
from .estimation.extended_kalman import ExtendedKalman as ExtendedKalman
from .estimation.inversion import Inversion as Inversion
from .estimation.kalman import Kalman as Kalman
from .estimation.moving_horizon import MovingHorizon as MovingHorizon
from .estimation.observer import Observer as Observer
from .files.case_file import load_case as load_case, save_case as save_case
from .files.profile_file import profile_from_file as profile_from_file
from .files.tables import save as save
from .model import frequency_responses as frequency_responses
from .model.frequency_responses import frequency_response as frequency_response
from .model.influence import influence_line as influence_line, static_peak as static_peak
from .model.plausibility.check import check as check
from .model.plausibility.checked_modes import modes as modes
from .model.settlement import settlement_response as settlement_response
from .model.state_space import state_space as state_space
from .model.static_correction import bending_moment as bending_moment, shear_force as shear_force
from .model.statics import static_deflection as static_deflection
from .simulation.coil_history import coil_history as coil_history
from .simulation.corrected_deflection import corrected_deflection as corrected_deflection
from .simulation.record import Record as Record, Result as Result
from .simulation.simulate import simulate as simulate
from .simulation.simulator import Simulator as Simulator
from .simulation.stored_record import read_record as read_record
from .sweeps.sweep import sweep as sweep

from . import api as api
from .analysis.absorber_tuning import tuned_absorber as tuned_absorber
from .analysis.assessment.assess import assess as assess
from .analysis.assessment.assessment import Assessment as Assessment, CodeCheck as CodeCheck
from .analysis.bound.bound import bound as bound
from .analysis.bound.least_integral import least_integral as least_integral
from .analysis.control_systems import to_control as to_control
from .analysis.ride import (
    RideMeasures as RideMeasures,
    ride_measures as ride_measures,
    sperling_index as sperling_index,
    vibration_dose as vibration_dose,
    weighted_acceleration as weighted_acceleration,
    weighted_rms as weighted_rms,
    wheel_unloading as wheel_unloading,
)
from .analysis.sections.amplification import (
    Envelope as Envelope,
    amplification as amplification,
    envelope as envelope,
)
from .analysis.sections.characteristic_points import characteristic_points as characteristic_points
from .case.absorbers import Absorber as Absorber
from .case.actuators.creep import Creep as Creep
from .case.actuators.electrodynamic import Electrodynamic as Electrodynamic
from .case.actuators.hysteresis import Hysteresis as Hysteresis
from .case.actuators.inner_loops import CurrentLoop as CurrentLoop, ForceLoop as ForceLoop
from .case.actuators.patch import Patch as Patch
from .case.actuators.point import PointForce as PointForce
from .case.actuators.shaker import Shaker as Shaker
from .case.actuators.spring import SpringDamper as SpringDamper
from .case.beam import Beam as Beam, Support as Support
from .case.beam_parts.damping import rayleigh_coefficients as rayleigh_coefficients
from .case.beam_parts.hinge import Hinge as Hinge
from .case.beam_parts.segment import Segment as Segment
from .case.case import Case as Case, Run as Run, addresses as addresses, replace as replace
from .case.filters import Filter as Filter
from .case.loads.axles import Axles as Axles
from .case.loads.force import MovingForce as MovingForce
from .case.loads.half_car import HalfCar as HalfCar
from .case.loads.line_load import LineLoad as LineLoad
from .case.loads.mass import MovingMass as MovingMass
from .case.loads.oscillator import Oscillator as Oscillator
from .case.loads.planar.files import load_vehicle as load_vehicle
from .case.loads.planar.parts import (
    VehicleAxle as VehicleAxle,
    VehicleBody as VehicleBody,
    VehicleHinge as VehicleHinge,
    VehicleSpring as VehicleSpring,
)
from .case.loads.planar.sensors import VehicleSensor as VehicleSensor
from .case.loads.planar.train import Coach as Coach, TrainLoad as TrainLoad
from .case.loads.quarter_car import QuarterCar as QuarterCar
from .case.loads.varying_force import VaryingForce as VaryingForce
from .case.loads.vehicle import VehicleLoad as VehicleLoad
from .case.loads.wagon import Wagon as Wagon
from .case.loads.walking.crowd import Crowd as Crowd
from .case.loads.walking.pedestrian import Pedestrian as Pedestrian
from .case.profiles.bump import BumpProfile as BumpProfile
from .case.profiles.iso8608 import ISO8608Profile as ISO8608Profile
from .case.profiles.rail import RailProfile as RailProfile
from .case.profiles.ramp import RampProfile as RampProfile
from .case.profiles.sine import SineProfile as SineProfile
from .case.profiles.spectrum import SpectrumProfile as SpectrumProfile
from .case.profiles.step import StepProfile as StepProfile
from .case.profiles.table import TableProfile as TableProfile
from .case.sensors import Sensor as Sensor
from .control.compensators import (
    PD as PD,
    PositivePositionFeedback as PositivePositionFeedback,
)
from .control.feedback import Feedback as Feedback
from .control.feedforward import Feedforward as Feedforward
from .control.internal_model.scheduled import ScheduledInternalModel as ScheduledInternalModel
from .control.internal_model.table import InternalModel as InternalModel
from .control.load_identification import (
    LoadIdentification as LoadIdentification,
    identified_load as identified_load,
)
from .control.optimal.h_infinity import HInfinity as HInfinity
from .control.optimal.lqr import LQR as LQR
from .control.optimal.sampling_loss import sampling_limit as sampling_limit
from .control.output_feedback import OutputFeedback as OutputFeedback
from .control.predictive.adaptive_gpc import AdaptiveGPC as AdaptiveGPC
from .control.predictive.gpc import GPC as GPC
from .control.predictive.mpc import MPC as MPC
from .control.predictive.scenario_mpc import ScenarioMPC as ScenarioMPC
from .control.prescribed import Prescribed as Prescribed
from .control.receptance import (
    ReceptanceFeedback as ReceptanceFeedback,
    closed_loop_poles as closed_loop_poles,
    fit_receptances as fit_receptances,
    receptance_feedback as receptance_feedback,
    receptance_gains as receptance_gains,
    receptances as receptances,
)
from .control.scheduled_feedback import ScheduledFeedback as ScheduledFeedback
from .control.sliding_mode import SlidingMode as SlidingMode
from .control.state_feedback import StateFeedback as StateFeedback
from .estimation.extended_kalman import ExtendedKalman as ExtendedKalman
from .estimation.inversion import Inversion as Inversion
from .estimation.kalman import Kalman as Kalman
from .estimation.moving_horizon.estimator import MovingHorizon as MovingHorizon
from .estimation.observer import Observer as Observer
from .files.case_file import load_case as load_case, save_case as save_case
from .files.profile_file import profile_from_file as profile_from_file
from .files.sweep_table import sweep_columns as sweep_columns
from .files.tables import save as save
from .model.frequency_response import (
    accelerance as accelerance,
    frequency_response as frequency_response,
    mobility as mobility,
    receptance as receptance,
)
from .model.influence import influence_line as influence_line, static_peak as static_peak
from .model.plausibility.check import check as check
from .model.plausibility.checked_modes import modes as modes
from .model.plausibility.numbers import Plausibility as Plausibility
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

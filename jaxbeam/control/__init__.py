"""Controllers, one family a file, behind the interface in `controller`."""

from jaxbeam.control.compensators import PD, Lead, PositivePositionFeedback
from jaxbeam.control.feedback import Feedback
from jaxbeam.control.feedforward import Passage
from jaxbeam.control.internal_model import Relief
from jaxbeam.control.load_identification import Recognised, Recognition, recognised
from jaxbeam.control.optimal.lqr import LQR, AugmentedLQR, FiniteLQR, StepLQR
from jaxbeam.control.optimal.sampled_lqr import DiscreteLQR
from jaxbeam.control.optimal.sampling_loss import SamplingWarning, sampling_limit
from jaxbeam.control.optimal.scheduled_lqr import ScheduledLQR
from jaxbeam.control.predictive.mpc import MPC
from jaxbeam.control.prescribed import Prescribed
from jaxbeam.control.scheduled_feedback import ScheduledFeedback
from jaxbeam.control.state_feedback import StateFeedback

KINDS = {
    "dlqr": DiscreteLQR,
    "feedback": Feedback,
    "feedback-scheduled": ScheduledFeedback,
    "lead": Lead,
    "lqr": LQR,
    "lqr-augmented": AugmentedLQR,
    "lqr-finite": FiniteLQR,
    "lqr-scheduled": ScheduledLQR,
    "lqr-step": StepLQR,
    "mpc": MPC,
    "passage": Passage,
    "pd": PD,
    "ppf": PositivePositionFeedback,
    "prescribed": Prescribed,
    "relief": Relief,
    "state": StateFeedback,
}

__all__ = [
    "KINDS",
    "LQR",
    "MPC",
    "PD",
    "AugmentedLQR",
    "DiscreteLQR",
    "Feedback",
    "FiniteLQR",
    "Lead",
    "Passage",
    "PositivePositionFeedback",
    "Prescribed",
    "Recognised",
    "Recognition",
    "Relief",
    "SamplingWarning",
    "ScheduledFeedback",
    "ScheduledLQR",
    "StateFeedback",
    "StepLQR",
    "recognised",
    "sampling_limit",
]

"""Controllers, one family a file, behind the interface in `controller`."""

from jaxbeam.control.compensators import PD, Lead, PositivePositionFeedback
from jaxbeam.control.discrete import DiscreteLQR
from jaxbeam.control.feedback import Feedback
from jaxbeam.control.lqr import LQR, AugmentedLQR, FiniteLQR, StepLQR
from jaxbeam.control.mpc import MPC
from jaxbeam.control.passage import Passage
from jaxbeam.control.prescribed import Prescribed
from jaxbeam.control.recognition import Recognised, Recognition, recognised
from jaxbeam.control.relief import Relief
from jaxbeam.control.sampling import SamplingWarning, sampling_limit
from jaxbeam.control.scheduled import ScheduledLQR
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

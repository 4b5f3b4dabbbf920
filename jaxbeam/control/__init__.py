"""Controllers, one family a file, behind the interface in `controller`."""

from jaxbeam.control.feedback import Feedback
from jaxbeam.control.prescribed import Prescribed
from jaxbeam.control.state_feedback import StateFeedback

KINDS = {"feedback": Feedback, "prescribed": Prescribed, "state": StateFeedback}

__all__ = [
    "KINDS",
    "Feedback",
    "Prescribed",
    "StateFeedback",
]

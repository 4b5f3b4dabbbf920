"""Every printed number of the thesis that a computation can be held against.

Facts only: the numbers as printed, where, their unit, whether they were measured or computed, and
how near ours must come; a file for each chapter in `experiments.printed`. The tolerances follow
from the kind of number and were chosen before any of the experiments was run; what else explains a
number is in its experiment. Not listed, because nothing here bears on them: times that the author's
computer took (Figs 7.4, 7.8), measured velocities (Fig. 5.22), the 0.1 mm by which a lever of the
supports sank (Figs 2.11 to 2.13), and curves without a number (Figs 2.7, 2.10, 2.21, 2.22, 2.31 to
2.36, 5.1 to 5.4, 5.14 to 5.16, 5.29).

The thesis: "Active structural control of single and multi-span beam structures subjected to
transient loads", Liverpool John Moores University. Its measured curves are not available.
"""

from experiments.thesis.chapter2.published import *  # noqa: F403
from experiments.thesis.chapter5.published import *  # noqa: F403
from experiments.thesis.chapter6.published import *  # noqa: F403
from experiments.thesis.chapter7.published import *  # noqa: F403

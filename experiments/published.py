"""Every printed number of the thesis that a computation can be held against.

Facts only: the numbers as printed, where, their unit, whether they were measured or computed, and
how near ours must come. The tolerances follow from the kind of number and were chosen before any
of the experiments was run; what else explains a number is in its experiment. Not listed, because
nothing here bears on them: times that the author's computer took (Figs 7.4, 7.8), measured
velocities (Fig. 5.22), and curves without a number.

The thesis: "Active structural control of single and multi-span beam structures subjected to
transient loads", Liverpool John Moores University. Its measured curves are not available.
"""

from experiments.printed.chapter2 import *  # noqa: F403
from experiments.printed.chapter5 import *  # noqa: F403
from experiments.printed.chapter6 import *  # noqa: F403
from experiments.printed.chapter7 import *  # noqa: F403

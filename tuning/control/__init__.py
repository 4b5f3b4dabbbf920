"""Controllers tuned by gradients through the closed loop."""

from tuning.control.pareto import lexicographic, tune_integers, tune_reduced
from tuning.control.run_set import draw_plants, with_identified_plant

__all__ = ["draw_plants", "lexicographic", "tune_integers", "tune_reduced", "with_identified_plant"]

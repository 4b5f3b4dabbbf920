from .animation import animate as animate
from .compare import plot_comparison as plot_comparison
from .engineering import (
    plot_assessment as plot_assessment,
    plot_envelope as plot_envelope,
    plot_influence as plot_influence,
)
from .fit import FitPanel as FitPanel, plot_fit as plot_fit
from .modes import (
    plot_frequency_response as plot_frequency_response,
    plot_loop_gain as plot_loop_gain,
    plot_modes as plot_modes,
    plot_poles as plot_poles,
)
from .realisations import plot_realisations as plot_realisations
from .record import plot_record as plot_record
from .sweep import plot_sweep as plot_sweep
from .tuning import (
    TuningPanel as TuningPanel,
    plot_pareto_front as plot_pareto_front,
    plot_tuning as plot_tuning,
)
from .vehicles import plot_vehicles as plot_vehicles

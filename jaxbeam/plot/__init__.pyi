from .animation import animate as animate
from .comparison import plot_comparison as plot_comparison
from .drawing import plot_vehicles as plot_vehicles
from .engineering import (
    plot_assessment as plot_assessment,
    plot_envelope as plot_envelope,
    plot_influence as plot_influence,
)
from .modes import (
    plot_frequency_response as plot_frequency_response,
    plot_loop_gain as plot_loop_gain,
    plot_modes as plot_modes,
    plot_poles as plot_poles,
)
from .record import plot_record as plot_record
from .sweep import plot_realisations as plot_realisations, plot_sweep as plot_sweep
from .tuning import (
    FitPanel as FitPanel,
    TuningPanel as TuningPanel,
    plot_fit as plot_fit,
    plot_pareto_front as plot_pareto_front,
    plot_tuning as plot_tuning,
)

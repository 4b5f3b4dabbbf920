from .environment import Environment as Environment
from .gymnasium_form import GymnasiumEnvironment as GymnasiumEnvironment
from .problem import load as load, names as names
from .scoring import baselines as baselines, score as score

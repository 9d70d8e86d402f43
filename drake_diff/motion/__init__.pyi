from .gradient import RolloutGradient as RolloutGradient
from .policy import ParametricPolicy as ParametricPolicy
from .rollout import Rollout as Rollout
from .smoothing import Barrier as Barrier
from .smoothing import Gaussian as Gaussian
from .smoothing import Smoothed as Smoothed
from .undefined import Undefined as Undefined

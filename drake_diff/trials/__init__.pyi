from .files import save_robustness as save_robustness
from .run import Robustness as Robustness
from .run import robustness as robustness

from .files import save_robustness as save_robustness
from .record import RobustnessRecord as RobustnessRecord
from .run import Robustness as Robustness
from .run import robustness as robustness

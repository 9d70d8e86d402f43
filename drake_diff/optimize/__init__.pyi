from .phased import PhasedSolution as PhasedSolution
from .problem.coupling import Coupling as Coupling
from .problem.coupling import Periodic as Periodic
from .problem.dynamics import DiscreteMap as DiscreteMap
from .problem.dynamics import plant_dynamics as plant_dynamics
from .problem.phases import PhasedProblem as PhasedProblem
from .problem.timed import TrackingCost as TrackingCost
from .transcription.between import violation_between_nodes as violation_between_nodes

from .problem.dynamics import plant_dynamics as plant_dynamics
from .transcription.collocation import violation_between_nodes as violation_between_nodes

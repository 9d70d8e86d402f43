from .problem.dynamics import plant_dynamics as plant_dynamics
from .transcription.motion import Transcribed as Transcribed
from .transcription.motion import violation_between_nodes as violation_between_nodes
from .transcription.solve import transcribe_and_solve as transcribe_and_solve

from .planner import Plan as Plan
from .planner import plan as plan

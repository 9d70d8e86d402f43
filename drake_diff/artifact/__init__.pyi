from .listing import RunComparison as RunComparison
from .listing import RunLine as RunLine
from .listing import compare_runs as compare_runs
from .listing import list_runs as list_runs
from .measurement import Measurement as Measurement
from .measurement import measure as measure
from .trace import Trace as Trace
from .verify import Verification as Verification

from .files import save_comparison as save_comparison
from .recordings import Recording as Recording
from .recordings import read_recording as read_recording
from .result import Comparison as Comparison
from .side_by_side import compare as compare

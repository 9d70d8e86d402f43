from .identify import Identification as Identification
from .identify import identify as identify
from .write_model import write_model as write_model

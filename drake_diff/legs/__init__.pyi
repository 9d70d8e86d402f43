from .standing import Standing as Standing
from .standing import stand as stand

"""A robot file or diagram as a discrete plant: its state, inputs, parameters, contract, and one step.

`dd.load_model` and `dd.model_from_diagram` make a Model. This package has the Contract of a model, `softened` and
SoftContact for forces at a distance, and `quantities`, the functions of the state for costs and constraints.

Example:
    >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
    >>> isinstance(model.contract, dd.model.Contract)
    True
"""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

"""What a comparison says of the cause of a recorded motion: the answer of `explain` as evidence in its record."""

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import DrakeDiffError
from drake_diff.identification.explain import explain
from drake_diff.model.model import Model
from drake_diff.runs.other_records import CauseEvidence, Numbers


def cause_of(model: Model, recording: Recording) -> CauseEvidence:
    """The smallest change of the model that explains a recording; or why none was looked for.

    Args:
        model: The model.
        recording: A motion of it.

    Returns:
        Names, values and 95 % intervals of what is changed, and a sentence.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> log = dd.Recording("lab", "1", [0.0, 0.01], [[1.0, 0.0], [0.99, -0.1]], [[0.0]])
        >>> dd.identification.cause_of(model, log).sentence[:38]
        'No cause was looked for: recording lab'
    """
    try:
        found = explain(model, recording)
    except DrakeDiffError as error:
        sentence = f"No cause was looked for: {error}"
        return CauseEvidence(names=[], values={}, intervals={}, alternatives=[], explained=False, sentence=sentence)
    return CauseEvidence(
        names=list(found.names),
        values={name: _numbers(np.atleast_1d(value)) for name, value in found.values.items()},
        intervals={name: [_numbers(row) for row in np.atleast_2d(each)] for name, each in found.intervals.items()},
        alternatives=[list(names) for names in found.alternatives],
        explained=found.explained,
        sentence=found.sentence,
    )


def _numbers(values: Array) -> Numbers:
    return [float(value) if np.isfinite(value) else None for value in values]

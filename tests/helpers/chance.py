"""The probability that noise makes `dd.explain` name a change of a correct model, if its motion is linear."""

import numpy as np

from drake_diff.comparison.recordings import Recording
from drake_diff.identification.candidates import Candidates
from drake_diff.identification.recordings import given_noise, read_pieces
from drake_diff.identification.tree import tree_for_identification


def chance_of_a_name(model, recording: Recording, draws: int, seed: int = 0) -> tuple[float, float]:
    """Return (share of noise draws in which a change exceeds the limit, share in which one exceeds BIC's penalty).

    If the model is correct and residuals are white, b of the least squares |b - R dz|^2 has independent normal entries,
    and a change by itself reduces the squares by the part of b in the change's own columns.
    """
    pieces, noise = read_pieces(model, recording, 0.0), given_noise(model, None)
    setting = Candidates(model, pieces, noise, tree=tree_for_identification(model))
    setting.prepare()
    view = setting.view(setting.cut, setting.unknowns.z_start, setting.starts)
    pulled = np.random.default_rng(seed).standard_normal((draws, len(view.reduced.b))) @ view.reduced.R
    named, by_bic = np.zeros((2, draws), dtype=bool)
    for s, freedom in zip(view.unknowns.slices, view.freedoms, strict=True):
        H = view.matrix[s, s]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        sizes, directions = np.linalg.eigh(H * np.outer(scale, scale))
        kept = sizes > 1e-12 * np.max(sizes)
        falls = np.sum(((pulled[:, s] * scale) @ directions[:, kept]) ** 2 / sizes[kept], axis=1)
        named |= falls > setting.least(max(freedom, 1.0), len(view.freedoms))
        by_bic |= falls > max(freedom, 1.0) * np.log(setting.count)
    return float(np.mean(named)), float(np.mean(by_bic))

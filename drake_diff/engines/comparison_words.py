"""What a comparison found, in sentences: per engine what it is and why, and which output to trust for what."""

from collections.abc import Iterable

import numpy as np

from drake_diff.engines.compared import STEP_TOLERANCE, Compared, Comparison
from drake_diff.engines.recorded import NOT_TOLD


def sentence_of(compared: Compared) -> str:
    """What one engine is beside Drake, and why."""
    told = {"same": _same, "other law": _other_law, "other model": _other_model, "unexplained": _unexplained}[
        compared.verdict
    ]
    return told(compared)


def verdict_of(comparison: Comparison) -> str:
    """All of it in a sentence or two: who is the same, who is not, whose gradients are their own steps'."""
    others = comparison.engines[1:]
    parts = []
    for verdict, said in (
        ("same", "the same simulation as Drake"),
        ("other law", "the same model under another law"),
        ("other model", "another model: its contract is broken"),
        ("unexplained", "different, and nothing tells why"),
    ):
        names = [e.engine for e in others if e.verdict == verdict]
        parts += [f"{_list(names)}: {said}"] if names else []
    if not parts:
        parts.append("no engine was compared")
    return "; ".join(parts) + ". " + _trust(comparison) + _after_contact(others)


def _trust(comparison: Comparison) -> str:
    own, wrong, open_, blind = (
        [e.engine for e in comparison.engines if e.gradient == kind]
        for kind in ("its own step's", "not its own step's", "undecided", "none")
    )
    parts = [f"Gradients to trust at the states looked at: {_list(own)}"] if own else ["No gradient to trust"]
    parts += [f"not those of {_list(wrong)}, which are not the derivatives of their own steps"] if wrong else []
    parts += [f"those of {_list(open_)} could not be decided"] if open_ else []
    parts += [f"{_list(blind)} {'offer' if len(blind) > 1 else 'offers'} none"] if blind else []
    return "; ".join(parts) + "."


def _after_contact(others: tuple[Compared, ...]) -> str:
    if not any("contact law" in (e.first.responsible, e.largest.responsible) for e in others if e.verdict != "same"):
        return ""
    return " From the first touch on a state is only as good as the contact law: drake-diff contact-table."


def _same(e: Compared) -> str:
    unused = [line.quantity for line in e.different if line.reason != NOT_TOLD]
    but = f"; what its contract has otherwise ({_list(unused)}) did not come into play" if unused else ""
    jacobians = f", Jacobians within {_largest(e.jacobian_gaps)} of their largest entry" if e.jacobians else ""
    return (
        f"the same simulation: each of {len(e.step_gaps)} steps within {_largest(e.step_gaps)} of Drake's"
        f"{jacobians}{but}"
    )


def _other_law(e: Compared) -> str:
    if e.first_apart is None:
        i = max(e.other_states, key=lambda state: e.jacobian_gaps[state])
        reason = "; ".join(dict.fromkeys(line.reason or line.detail for line in e.tells(e.laws[i])[:1]))
        return (
            f"the same motion, each of {len(e.step_gaps)} steps within {_largest(e.step_gaps)} of Drake's; another "
            f"Jacobian at the {e.jacobians[i].state} state, by the {e.laws[i]} ({reason})"
        )
    k = e.first_apart or 0
    before = "from the first step on" if k == 0 else f"the same for {e.motion.times[k]:.4g} s, then apart"
    terms = list(dict.fromkeys((e.first.responsible, e.largest.responsible)))
    lines = {line.quantity: line.reason or line.detail for line in e.told}
    why = "; ".join(lines[term] for term in terms if term in lines) or "; ".join(lines.values())
    why = "; ".join(part for part in (why, e.first.as_if) if part)
    return f"{before} by the {_list(terms)}, at most {_largest(e.step_gaps)} of the state in one step ({why})"


def _other_model(e: Compared) -> str:
    lines = "; ".join([f"{line.quantity}: {line.detail}" for line in e.broken] or [e.first.as_if])
    return (
        f"another model ({lines}); a step differs by up to {_largest(e.step_gaps)}, most by its {e.largest.responsible}"
    )


def _unexplained(e: Compared) -> str:
    if e.first_apart is not None:
        return (
            f"apart from t = {e.motion.times[e.first_apart]:.4g} s on by up to {_largest(e.step_gaps)} in one step, "
            f"above {STEP_TOLERANCE[e.precision]:g}; the largest part is {e.largest.responsible}, and no line of its "
            "contract tells of it"
        )
    if e.motion.status != "ok":
        return e.motion.status
    worst = int(np.argmax(e.jacobian_gaps))
    return (
        f"every step is Drake's, but its Jacobian at the {e.jacobians[worst].state} state is off by "
        f"{e.jacobian_gaps[worst]:.1e} of its largest entry"
    )


def _largest(values: Iterable[float]) -> str:
    return f"{max(values, default=0.0):.1e}"


def _list(names: list[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)

"""What the trials found, in sentences: the weakest point, what fails first, who is to blame, what gradients knew."""

from collections import Counter

from drake_diff.trials.perturbation import perturbation_named
from drake_diff.trials.run import Robustness

AGREE = 2.0  # within this factor of what is measured a prediction counts as one


def verdict_of(result: Robustness) -> str:
    """All of it in a paragraph."""
    nominal = result.task.nominal
    first = "Unperturbed it succeeds." if nominal.success else f"Unperturbed it fails: {nominal.failures[0]}."
    return " ".join((first, _weakest(result), _blame(result), _gradients(result))).replace("  ", " ")


def weakest_of(result: Robustness) -> str:
    """The perturbation with the smallest margin, as a part of its largest usual level; of equals the least survived."""

    def rank(name: str) -> tuple[float, float]:
        tried = result.of(name)
        return result.margins[name] / perturbation_named(name).levels[-1], sum(c.rate.value for c in tried) / len(tried)

    return min(result.names, key=rank)


def agrees(ratio: float | None) -> bool:
    """Whether a measured displacement is within a factor of AGREE of the predicted one."""
    return ratio is not None and 1 / AGREE <= ratio <= AGREE


def sized(name: str, level: float) -> str:
    """A level with its unit."""
    unit = perturbation_named(name).unit
    return f"{level:g}" + ("" if unit == "1" else f" {unit}")


def _weakest(result: Robustness) -> str:
    failing = [c for c in result.cells if c.rate.successes < c.rate.trials]
    if not failing:
        return f"No trial fails: each of {len(result.names)} perturbations is survived up to its largest level."
    name = weakest_of(result)
    held, cell = result.margins[name], result.worst(name)
    much = f"with a margin of {sized(name, held)}" if held else "with no margin"
    told = f"at {sized(name, cell.level)} {cell.rate.successes} of {cell.rate.trials} succeed"
    return f"Weakest point: {name}, {much}: {told}. What fails first: {cell.worst.reason}."


def _blame(result: Robustness) -> str:
    labels = sum((Counter(c.labels) for c in result.cells), Counter())
    if not labels:
        return ""
    of = ", ".join(f"{count} {label.replace('_', ' ')}{'s' * (count > 1)}" for label, count in labels.most_common())
    count = sum(labels.values())
    return f"Of {count} failed trial{'s' * (count > 1)}: {of}."


def _gradients(result: Robustness) -> str:
    told = [c for c in result.cells if c.ratio is not None]
    if not told:
        return "No gradient predicts any of it."
    right = sum(agrees(c.ratio) for c in told)
    name = weakest_of(result)
    known = [c for c in result.of(name) if c.ratio is not None]
    about = f"they tell nothing of {name}"
    if known:
        about = f"of {name} in {sum(agrees(c.ratio) for c in known)} of {len(known)}"
    return (
        f"Gradients predict the displacement of the last state within a factor of {AGREE:g} in {right} of the "
        f"{len(told)} cells that they tell of; {about}."
    )

"""What a record claims, in a few lines: a weaker claim can be just as true, so that a reader has to see it."""

from collections.abc import Iterator, Sequence
from typing import Any

from drake_diff.runs.differences import shown
from drake_diff.runs.other_records import ComparisonRecord, FitRecord
from drake_diff.runs.plan_record import PhasesSection, PlanRecord
from drake_diff.runs.sealed import SealedRecord
from drake_diff.runs.sections import COSTS, LIMITS

MOST = 8  # entries of a list: of a longer one the others are counted


def claims_of(record: SealedRecord) -> tuple[str, ...]:
    """The lines: the verdict, the model and how it was loaded, and what was asked."""
    if isinstance(record, PlanRecord) and record.phases is not None:
        return (f"{record.verdict}: {record.sentence}", *_of_phases(record.phases))
    file = record.model.file
    options = ", ".join(f"{k} {shown(v)}" for k, v in sorted((record.model.options or {}).items()) if v is not None)
    model = (
        "a user's own diagram or function" if file is None else f"{file.path} ({(file.sha256 or '')[:12]}), {options}"
    )
    lines = [f"{record.verdict}: {record.sentence}", f"of the model {model}"]
    if isinstance(record, PlanRecord) and record.certification is not None:
        c = record.certification
        parameters = ", ".join(c.parameters) or "no parameter"
        lines.append(f"certificates at {len(c.states)} states of seed {c.seed}, by {c.method}, with {parameters}")
    elif isinstance(record, PlanRecord) and record.subject == "plan":
        lines += _of_a_solve(record)
    elif isinstance(record, FitRecord):
        lines += _of_an_identification(record)
    elif isinstance(record, ComparisonRecord):
        lines += [f"cause of {e.engine}: {e.cause.sentence}" for e in record.engines if e.cause is not None]
    return tuple(lines)


def _of_phases(record: PhasesSection) -> Iterator[str]:
    unit = "steps" if record.counts_steps else "s"
    for phase in record.phases:
        yield f"{phase.name}, {phase.duration:.6g} {unit}, {phase.status}: what it asks is in {phase.directory}"
    names = [phase.name for phase in record.phases]
    for link in record.links:
        one, other = (names[i] if 0 <= i < len(names) else i for i in (link.before, link.after))
        yield f"from {one} to {other}: {link.told}, {shown(link.reset)}, within {link.tolerance:g}"
    if record.horizon_s is not None:
        yield f"in all {listed(record.horizon_s)} s"
    search = ", ".join(f"{k} {shown(v)}" for k, v in sorted((record.search or {}).items()) if v is not None)
    yield f"by solve with {search or 'arguments that are not recorded'}"


def _of_an_identification(record: FitRecord) -> Iterator[str]:
    asked = record.inputs
    yield f"parameters {asked.parameters if isinstance(asked.parameters, str) else listed(asked.parameters)}"
    yield f"noise {shown(asked.noise) if asked.noise else 'estimated'}, held out {shown(asked.held_out)}"
    yield f"motion {asked.motion}, in at most {asked.max_iterations} steps"
    for r in record.recordings:
        file = "given as arrays" if r.file is None else f"{r.file} ({(r.sha256 or '')[:12]})"
        yield f"recording {r.name}, {r.samples} samples, {file}"


def _of_a_solve(record: PlanRecord) -> Iterator[str]:
    p: dict[str, Any] = dict(record.problem)
    names, inputs = p.get("state_names"), p.get("input_names")
    free = p.get("free_horizon_s")
    horizon = f"{listed(free)} s" if isinstance(free, list) else f"{shown(p.get('horizon_s'))} s"
    to = named(names, p.get("x_goal")) or "no goal"
    count = f"{p.get('num_steps')} intervals of {shown(p.get('time_step_s'))} s, horizon {horizon}"
    yield f"from {named(names, p.get('x0'))} to {to} in {count}"
    bounds = [(side, named(of, p.get(side))) for side, of in zip(LIMITS, (names, names, inputs, inputs), strict=True)]
    yield "bounds: " + ("; ".join(f"{side} {told}" for side, told in bounds if told) or "none")
    if p.get("held"):
        yield f"with points that are held: {shown(p['held'])}"
    if p.get("waypoints"):
        yield f"waypoints {shown(p['waypoints'])}"
    for goal in p.get("goals") or ():
        yield f"goal {shown(goal)}"
    for c in p.get("constraints") or ():
        yield f"constraint {shown(c)}"
    for c in p.get("couplings") or ():
        yield f"coupling {shown(c)}"
    yield from (f"{name.replace('_', ' ')} {shown(p[name])}" for name in COSTS if p.get(name) is not None)
    started = [f"{e.name} from {e.start:.9g} within [{shown(e.lower)}, {shown(e.upper)}]" for e in record.parameters]
    mask = p.get("initial_state_free")
    moved = [str(name) for name, free in zip(names or (), mask if isinstance(mask, list) else (), strict=False) if free]
    started += [f"the first {', '.join(moved)}"] if moved else []
    yield f"optimized: {', '.join(map(str, p.get('optimize') or ()))}" + "".join(f"; {line}" for line in started)
    tolerances = ", ".join(f"{m.name} {m.tolerance:g} {m.unit}" for m in record.metrics if m.tolerance is not None)
    yield f"within {tolerances}"
    search = ", ".join(f"{k} {shown(v)}" for k, v in sorted((record.inputs.search or {}).items()) if v is not None)
    yield f"by solve with {search or 'arguments that are not recorded'}"


def named(names: Any, values: Any) -> str:
    """Values with their names where there is one: "hinge_q 3.14"; of many those that are not 0."""
    if not isinstance(values, list) or not isinstance(names, list):
        return shown(values)
    given = [(str(name), v) for name, v in zip(names, values, strict=False) if v is not None]
    if len(given) <= MOST:
        return listed([f"{name} {shown(v)}" for name, v in given])
    told = [f"{name} {shown(v)}" for name, v in given if v != 0]
    return ", ".join([*told, f"the other {len(given) - len(told)} given ones 0"])


def listed(values: Sequence[Any]) -> str:
    """A list on one line, the first few of it."""
    texts = [v if isinstance(v, str) else shown(v) for v in values]
    more = f" and {len(texts) - MOST} more" if len(texts) > MOST else ""
    return ", ".join(texts[:MOST]) + more

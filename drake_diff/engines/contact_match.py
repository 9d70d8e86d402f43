"""What touches what, where, and of what it is made, in two engines: only the law that follows is an engine's own."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from drake_diff.engines.contract_line import ContractLine, Match, values_told
from drake_diff.engines.interface import EngineContract
from drake_diff.mechanics.description import GeometryContract, PairContract

TOLD = 4  # pairs or geometries that a line names
Shared = Sequence[tuple[PairContract, PairContract]]


def contact_lines(match: Match) -> tuple[ContractLine, ...]:
    """Shapes, poses, pairs, friction, stiffness, dissipation, margin, and what Drake's contact does not have.

    A number that differs has no reason: it is another model. What an engine has no number for has its reason.
    """
    one, two = match.contracts
    same = same_geometries(match)
    a = {frozenset(same.get(name, name) for name in pair.names): pair for pair in one.contacts}
    b = {frozenset(pair.names): pair for pair in two.contacts}
    shared = [(a[names], b[names]) for names in a if names in b]
    return (
        *_geometries(match, same),
        _pairs(match, a, b),
        _numbers(match, "friction", shared, lambda pair: pair.friction, "[1]"),
        _numbers(match, "stiffness", shared, lambda pair: pair.stiffness, "[N/m]"),
        _dissipation(match, shared),
        _numbers(match, "contact margin", shared, lambda pair: pair.margin, "[m]"),
        _more(match, shared),
    )


def same_geometries(match: Match) -> dict[str, str]:
    """The name in the second engine of each geometry of the first that is there: by name, else by place, else nearest.

    A name is taken without what Drake puts around it: model::name#number.
    """
    a, b = (list(c.geometries) for c in match.contracts)
    found: dict[str, str] = {}
    touching = _touching(match.one) | _touching(match.two)

    def take(rule: Callable[[GeometryContract, GeometryContract], bool]) -> None:
        for x in [x for x in a if x.name not in found]:
            free = [y for y in b if y.name not in found.values() and rule(x, y)]
            if free:
                found[x.name] = min(free, key=lambda y: float(np.linalg.norm(np.subtract(x.position, y.position)))).name

    take(lambda x, y: x.name == y.name)
    take(lambda x, y: _plain(x.name) == _plain(y.name) and x.carrier == y.carrier)
    a, b = ([g for g in side if g.name in touching] for side in (a, b))
    take(lambda x, y: _same_shape(match, x, y) and _same_pose(match, x, y))
    take(lambda x, y: x.kind == y.kind and x.carrier == y.carrier)
    return found


def _plain(name: str) -> str:
    return name.split("#")[0].split("::")[-1]


def _touching(contract: EngineContract) -> set[str]:
    return {name for pair in contract.contacts for name in pair.names}


def _same_shape(match: Match, x: GeometryContract, y: GeometryContract) -> bool:
    return x.kind == y.kind and match.all_same(x.sizes, y.sizes)


def _same_pose(match: Match, x: GeometryContract, y: GeometryContract) -> bool:
    placed = match.all_same(x.position, y.position) and match.all_same(x.directions, y.directions)
    return x.carrier == y.carrier and placed


def _geometries(match: Match, same: Mapping[str, str]) -> tuple[ContractLine, ContractLine]:
    """Of those that are in both, and may touch something in one."""
    a, b = ({g.name: g for g in c.geometries} for c in match.contracts)
    touching = _touching(match.one), _touching(match.two)
    both = [(a[x], b[y]) for x, y in same.items() if x in touching[0] or y in touching[1]]
    shapes, poses = [], []
    for x, y in both:
        if not _same_shape(match, x, y):
            shapes.append(f"{x.name}: {match.both(*(f'{g.kind} {values_told(g.sizes)}' for g in (x, y)))} [m]")
        if not _same_pose(match, x, y):
            poses.append(f"{x.name}: {match.both(*map(_place, (x, y)))}")
    told = f"of {len(both)} geometries" if both else "nothing can touch"
    return _line(match, "shapes", shapes, told), _line(match, "poses", poses, told)


def _place(g: GeometryContract) -> str:
    along = f", directions {values_told(g.directions)}" if g.directions else ""
    return f"on {g.carrier} at {values_told(g.position)} [m]{along}"


def _line(match: Match, quantity: str, wrong: list[str], told: str) -> ContractLine:
    """What is wrong without a reason to excuse it; the engine's own word on it is told all the same."""
    if not wrong:
        return ContractLine(quantity, "equal", told)
    remark = match.one.reasons.get(quantity) or match.two.reasons.get(quantity)
    return ContractLine(quantity, "different", "; ".join([_some(wrong), *([remark] if remark else [])]))


def _some(parts: list[str]) -> str:
    return "; ".join(parts[:TOLD]) + (f"; and {len(parts) - TOLD} more" if len(parts) > TOLD else "")


def _pairs(
    match: Match, a: Mapping[frozenset[str], PairContract], b: Mapping[frozenset[str], PairContract]
) -> ContractLine:
    quantity = "contact pairs"
    if a.keys() == b.keys():
        return ContractLine(quantity, "equal", f"{len(a)} pairs" if a else "none")
    sides = ((match.one.engine, a, b), (match.two.engine, b, a))
    only = [
        f"only in {engine}: {_some(missing)}"
        for engine, own, others in sides
        if (missing := sorted(" with ".join(own[names].names) for names in own.keys() - others.keys()))
    ]
    return match.different(quantity, "; ".join([match.both(len(a), len(b)), *only]))


def _numbers(
    match: Match, quantity: str, shared: Shared, read: Callable[[PairContract], float | None], unit: str
) -> ContractLine:
    """A value that neither gives is the same default only where the contact law is the same."""
    wrong, absent, seen = [], [], set()
    for x, y in shared:
        p, q = read(x), read(y)
        seen.add(p)
        told = f"{' with '.join(x.names)}: {match.both(p, q)} {unit}"
        if p is None or q is None:
            absent += [told] if p is not q or match.one.contact_law != match.two.contact_law else []
        elif not match.same(p, q):
            wrong.append(told)
    if absent and not wrong:
        return match.different(quantity, _some(absent))
    values = sorted(value for value in seen if value is not None)
    told = f"{values_told(tuple(values[:TOLD]))} {unit}" if values else "of no pair"
    return _line(match, quantity, wrong + absent, told)


def _dissipation(match: Match, shared: Shared) -> ContractLine:
    """Hunt and Crossley's where both have it, and the relaxation time, or the critical one of an engine's own law."""
    quantity = "dissipation"
    wrong: list[str] = []
    absent: list[str] = []
    mapped: list[str] = []
    for x, y in shared:
        name = " with ".join(x.names)
        if x.dissipation is not None and y.dissipation is not None and not match.same(x.dissipation, y.dissipation):
            wrong.append(f"{name}: {match.both(x.dissipation, y.dissipation)} [s/m]")
        p, q = x.relaxation_time, y.relaxation_time
        told = f"{name}: {match.both(p, q)} [s]"
        if p is None or q is None:
            absent += [told] if p is not q else []
        elif not match.same(p, q):
            critical = any(_critical(match, pair) for pair in (x, y))
            (mapped if critical else wrong).append(told)
    if wrong:
        return _line(match, quantity, wrong, "")
    if absent:
        return match.different(quantity, _some(absent))
    if mapped:
        said = f"relaxation times {_some(mapped)}: the damping is critical, which is the engine's own"
        return ContractLine(quantity, "mapped", said)
    return ContractLine(quantity, "equal", f"of {len(shared)} pairs" if shared else "of no pair")


def _critical(match: Match, pair: PairContract) -> bool:
    times = pair.relaxation_time, pair.critical_time
    return None not in times and match.same(*times)


def _more(match: Match, shared: Shared) -> ContractLine:
    wrong = []
    for x, y in shared:
        p, q = dict(x.more), dict(y.more)
        for name in {**p, **q}:
            if not match.same(p.get(name, 0.0), q.get(name, 0.0)):
                both = match.both(p.get(name, 0.0), q.get(name, 0.0))
                wrong.append(f"{' with '.join(x.names)}: {name}, {both}")
    return _line(match, "other contact terms", wrong, "none")

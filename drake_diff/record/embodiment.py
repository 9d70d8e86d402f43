"""What the robot of a record is, read from its contract."""

from drake_diff.model.contract import Contract, CoordinateTerms, JointTerms
from drake_diff.model.plant import FLOATING
from drake_diff.record.parts import Drive, Embodiment

NO_BODY = Embodiment(
    robot="plain dynamics",
    base="none: equations alone, there is no body",
    driven=[],
    other_inputs=[],
    passive=[],
    fixed=[],
    sensed="the whole state, exactly: there is no sensor and no noise",
    touching=[],
)
WELD, WORLD = "weld", "world"


def embodiment_of(contract: Contract) -> Embodiment:
    """The robot of a contract: its base, what of it is driven and how, what only moves, is fixed, sensed, can touch."""
    inputs = {each.name: each for each in contract.inputs}
    names = {a.name for a in contract.actuators}
    driving = {a.joint for a in contract.actuators}
    moving = [j for j in contract.joints if j.type != WELD and not j.locked]
    return Embodiment(
        robot=contract.name,
        base=_base(contract, moving),
        driven=[
            Drive(
                actuator=a.name,
                joint=a.joint,
                command="effort" if a.kp is None else "effort, added to PD control to the joint's default position",
                unit=_unit(a.name, a.joint, inputs, contract),
                effort_limit=a.effort_limit if abs(a.effort_limit) < float("inf") else None,
                gear_ratio=a.gear_ratio,
                rotor_inertia=a.rotor_inertia,
                kp=a.kp,
                kd=a.kd,
            )
            for a in contract.actuators
        ],
        other_inputs=[f"{each.name} [{each.unit}]" for each in contract.inputs if each.name not in names],
        passive=[j.name for j in moving if j.name not in driving and j.type not in FLOATING],
        fixed=[f"{j.name}: {j.child} on {j.parent}{', locked' if j.locked else ''}" for j in _fixed(contract)],
        sensed="the whole state, exactly: there is no sensor and no noise",
        touching=list(dict.fromkeys(g.body for g in contract.geometries)) if contract.contact.collision_pairs else [],
    )


def _fixed(contract: Contract) -> list[JointTerms]:
    return [j for j in contract.joints if j.type == WELD or j.locked]


def _unit(actuator: str, joint: str, inputs: dict[str, CoordinateTerms], contract: Contract) -> str:
    """The input's own unit, or for an actuator without an input that of an effort on its joint."""
    if actuator in inputs:
        return inputs[actuator].unit
    kind = next((j.type for j in contract.joints if j.name == joint), "")
    return "N" if kind == "prismatic" else "N m"


def _base(contract: Contract, moving: list[JointTerms]) -> str:
    anchored, more = {WORLD}, True
    while more:  # what is fixed to what is fixed to the world is so too
        found = {j.child for j in _fixed(contract) if j.parent in anchored}
        more = not found <= anchored
        anchored |= found
    floating = [j.child for j in moving if j.type in FLOATING]
    held = [f"{j.child} by {j.name}" for j in moving if j.parent in anchored and j.type not in FLOATING]
    told = [f"free: {', '.join(floating)}"] if floating else []
    told += [f"held to the world: {', '.join(held)}"] if held else []
    return "; ".join(told) or "fixed to the world"

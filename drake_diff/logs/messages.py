"""Our own protobuf messages of trace.mcap, flat so that any viewer can plot them, built without protoc."""

from dataclasses import dataclass
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

NUMBER, NUMBERS = ("double", False), ("double", True)
WHOLE, FLAG, TEXT, TEXTS = ("int64", False), ("bool", False), ("string", False), ("string", True)

# message: {field: (type, unit)}; field numbers are the order, so new fields go last.
MESSAGES: dict[str, dict[str, tuple[tuple[str, bool], str]]] = {
    "State": {"time": (NUMBER, "s"), "q": (NUMBERS, "see names"), "v": (NUMBERS, "see names")},
    "Input": {"time": (NUMBER, "s"), "u": (NUMBERS, "see names")},
    "Diagnostics": {
        "energy_kinetic": (NUMBER, "J"),
        "energy_potential": (NUMBER, "J"),
        "energy_total": (NUMBER, "J"),
        "energy_error": (NUMBER, "J"),
        "work_actuators": (NUMBER, "J"),
        "dissipation": (NUMBER, "J"),
        "max_penetration": (NUMBER, "m"),
        "constraint_violation": (NUMBER, "m, rad or 1"),
        "n_contacts": (WHOLE, "1"),
    },
    "Contacts": {
        "body_a": (TEXTS, ""),
        "body_b": (TEXTS, ""),
        "px": (NUMBERS, "m"),
        "py": (NUMBERS, "m"),
        "pz": (NUMBERS, "m"),
        "nx": (NUMBERS, "1"),
        "ny": (NUMBERS, "1"),
        "nz": (NUMBERS, "1"),
        "fx": (NUMBERS, "N"),
        "fy": (NUMBERS, "N"),
        "fz": (NUMBERS, "N"),
        "depth": (NUMBERS, "m"),
        "slip_speed": (NUMBERS, "m/s"),
    },
    "SolverIteration": {
        "iteration": (WHOLE, "1"),
        "objective": (NUMBER, "1"),
        "primal_infeasibility": (NUMBER, "1"),
        "dual_infeasibility": (NUMBER, "1"),
        "step": (NUMBER, "1"),
    },
    "GradientCheck": {
        "subject": (TEXT, ""),
        "method": (TEXT, ""),
        "verdict": (TEXT, ""),
        "entries": (WHOLE, "1"),
        "agreeing": (WHOLE, "1"),
        "cosine": (NUMBER, "1"),  # of the angle between derivative and differences, all entries in one vector
        "worst_row": (TEXT, ""),
        "worst_column": (TEXT, ""),
        "worst_derivative": (NUMBER, "unit of the row per unit of the column"),
        "worst_difference": (NUMBER, "unit of the row per unit of the column"),
        "worst_tolerance": (NUMBER, "unit of the row per unit of the column"),
        "mode_changes": (TEXTS, ""),
    },
    "GradientNorm": {"step": (WHOLE, "1"), "norm": (NUMBER, "1 per state unit")},
    "Plan": {
        "scheme": (TEXT, ""),
        "num_steps": (WHOLE, "1"),
        "horizon": (NUMBER, "s"),
        "horizon_is_free": (FLAG, "1"),
        "parameters": (NUMBERS, "see names"),
    },
    "Replay": {
        "variant": (TEXT, ""),
        "control": (TEXT, ""),
        "approximation": (TEXT, ""),
        "time_step": (NUMBER, "s"),
        "goal_error": (NUMBER, "the state's"),
        "bound_violation": (NUMBER, "the state's"),
        "energy_error": (NUMBER, "J"),
        "penetration": (NUMBER, "m"),
        "holds": (FLAG, "1"),
        "failures": (TEXTS, ""),
    },
    "Event": {
        "time": (NUMBER, "s"),
        "kind": (TEXT, ""),
        "failure_label": (TEXT, ""),
        "code": (TEXT, ""),
        "message": (TEXT, ""),
    },
}


@dataclass(frozen=True)
class MessageType:
    """A message class and the units of its fields."""

    cls: Any
    units: dict[str, str]


def _build() -> dict[str, MessageType]:
    file = FileDescriptorProto(name="drake_diff.proto", package="drake_diff", syntax="proto3")
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for number, (field, ((kind, repeated), _)) in enumerate(fields.items(), start=1):
            message.field.add(
                name=field,
                number=number,
                type=getattr(FieldDescriptorProto, f"TYPE_{kind.upper()}"),
                label=FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL,
            )
    pool = DescriptorPool()
    pool.Add(file)
    return {
        name: MessageType(
            GetMessageClass(pool.FindMessageTypeByName(f"drake_diff.{name}")),
            {field: unit for field, (_, unit) in fields.items() if unit},
        )
        for name, fields in MESSAGES.items()
    }


TYPES = _build()

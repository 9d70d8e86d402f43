"""Our own protobuf messages of trace.mcap, flat so that any viewer can plot them, built without protoc."""

from dataclasses import dataclass
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

NUMBER, NUMBERS = ("double", False), ("double", True)
WHOLE, FLAG, TEXT, TEXTS = ("int64", False), ("bool", False), ("string", False), ("string", True)
ROW_PER_COLUMN = "unit of the row per unit of the column"

# message: {field: (type, unit)}; field numbers are the order, so new fields go last.
MESSAGES: dict[str, dict[str, tuple[tuple[str, bool], str]]] = {
    "State": {"time": (NUMBER, "s"), "q": (NUMBERS, "see names"), "v": (NUMBERS, "see names")},
    "Input": {"time": (NUMBER, "s"), "u": (NUMBERS, "see names")},
    "Diagnostics": {
        **dict.fromkeys(("energy_kinetic", "energy_potential", "energy_total", "energy_error"), (NUMBER, "J")),
        **dict.fromkeys(("work_actuators", "dissipation"), (NUMBER, "J")),
        "max_penetration": (NUMBER, "m"),
        "constraint_violation": (NUMBER, "m, rad or 1"),
        "n_contacts": (WHOLE, "1"),
    },
    "Contacts": {
        **dict.fromkeys(("body_a", "body_b"), (TEXTS, "")),
        **dict.fromkeys(("px", "py", "pz"), (NUMBERS, "m")),
        **dict.fromkeys(("nx", "ny", "nz"), (NUMBERS, "1")),
        **dict.fromkeys(("fx", "fy", "fz"), (NUMBERS, "N")),
        "depth": (NUMBERS, "m"),
        "slip_speed": (NUMBERS, "m/s"),
    },
    "SolverIteration": {
        "iteration": (WHOLE, "1"),
        **dict.fromkeys(("objective", "primal_infeasibility", "dual_infeasibility", "step"), (NUMBER, "1")),
    },
    "GradientCheck": {
        **dict.fromkeys(("subject", "method", "verdict"), (TEXT, "")),
        **dict.fromkeys(("entries", "agreeing"), (WHOLE, "1")),
        "cosine": (NUMBER, "1"),  # of the angle between derivative and differences, all entries in one vector
        **dict.fromkeys(("worst_row", "worst_column"), (TEXT, "")),
        **dict.fromkeys(("worst_derivative", "worst_difference", "worst_tolerance"), (NUMBER, ROW_PER_COLUMN)),
        "mode_changes": (TEXTS, ""),
    },
    "GradientNorm": {  # |d x_N / d x_k| and |d L / d x_k|; NaN where it is not known
        "step": (WHOLE, "1"),
        "final_state": (NUMBER, "state unit per state unit"),
        "lagrangian": (NUMBER, "1 per state unit"),
    },
    "Plan": {
        "scheme": (TEXT, ""),
        "num_steps": (WHOLE, "1"),
        "horizon": (NUMBER, "s"),
        "horizon_is_free": (FLAG, "1"),
        "parameters": (NUMBERS, "see names"),
        "mesh": (NUMBERS, "1"),  # the knots as parts of the horizon, where they are not equally far apart
    },
    "Replay": {
        **dict.fromkeys(("variant", "control", "approximation"), (TEXT, "")),
        "time_step": (NUMBER, "s"),
        **dict.fromkeys(("goal_error", "bound_violation"), (NUMBER, "the state's")),
        "energy_error": (NUMBER, "J"),
        "penetration": (NUMBER, "m"),
        "holds": (FLAG, "1"),
        "failures": (TEXTS, ""),
    },
    "Event": {"time": (NUMBER, "s"), **dict.fromkeys(("kind", "failure_label", "code", "message"), (TEXT, ""))},
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
            label = FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL
            code = getattr(FieldDescriptorProto, f"TYPE_{kind.upper()}")
            message.field.add(name=field, number=number, type=code, label=label)
    pool = DescriptorPool()
    pool.Add(file)
    found = {}
    for name, fields in MESSAGES.items():
        units = {field: unit for field, (_, unit) in fields.items() if unit}
        found[name] = MessageType(GetMessageClass(pool.FindMessageTypeByName(f"drake_diff.{name}")), units)
    return found


TYPES = _build()

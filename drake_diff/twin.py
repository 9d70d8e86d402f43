"""One scalar type of a model: its diagram and plant, and one context that is kept and reused."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff.added_forces import AddedForce
from drake_diff.plant_elements import actuators, bodies, joints, labelled


@dataclass(frozen=True, eq=False)
class Twin:
    """One scalar type of the model: its diagram, its plant, and one context that is kept and reused."""

    scalar: Any  # float or AutoDiffXd
    diagram: Any
    plant: Any
    scene_graph: Any
    root_context: Any
    context: Any  # the plant's, inside root_context
    defaults: Any  # a root context that nobody touches
    added: dict[str, AddedForce] = field(default_factory=dict)  # by parameters that Drake has not

    def body(self, label: str) -> Any:
        return self._bodies[label]

    def joint(self, label: str) -> Any:
        return self._joints[label]

    def actuator(self, label: str) -> Any:
        return self._actuators[label]

    @cached_property
    def _bodies(self) -> dict[str, Any]:
        return labelled(bodies(self.plant))

    @cached_property
    def _joints(self) -> dict[str, Any]:
        return labelled(joints(self.plant))

    @cached_property
    def _actuators(self) -> dict[str, Any]:
        return labelled(actuators(self.plant))

    @cached_property
    def _moving_joints(self) -> list[tuple[slice, Any]]:
        moving = [joint for joint in joints(self.plant) if joint.num_velocities()]
        return [(slice(j.velocity_start(), j.velocity_start() + j.num_velocities()), j) for j in moving]

    def damping(self) -> Any:
        """(nv,) the joint damping coefficients in the context [N s/m or N m s/rad]."""
        found = np.zeros(self.plant.num_velocities()).astype(self.scalar)
        for velocities, joint in self._moving_joints:
            found[velocities] = joint.GetDampingVector(self.context)
        return found

    def added_force(self) -> Any:
        """(nv,) the generalized force that parameters add in the state of the context."""
        return sum(force.force(self.plant, self.context) for force in self.added.values())

    def reset(self) -> None:
        """Put every parameter of the context back to the model's own."""
        self.root_context.SetTimeStateAndParametersFrom(self.defaults)
        if self.added:
            self.added.clear()
            port = self.plant.get_applied_generalized_force_input_port()
            port.FixValue(self.context, np.zeros(self.plant.num_velocities()).astype(self.scalar))

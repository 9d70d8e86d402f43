"""What the other side of an export has to do, in words."""

from collections.abc import Mapping, Sequence
from typing import Any

from drake_diff.engines.engine import EngineContract
from drake_diff.model import Model

README = """# {name} for {target}

Written by drake_diff from Drake's plant. `{file}` has every number of its bodies and joints; `contract.json` has them
again, with what the file cannot say (null is a limit that is none, or a value that the model does not give).
Shapes that are not in the file, to be added by hand: {left_out}. {about_usd}

## Set

{settings}

## Run

`initial_states.csv` has {count} states (seed {seed}). From each, apply the row of `inputs.csv` with the same number,
for the whole motion, for about a second. Start at exactly this state: no settling, no noise. Their distribution:
{distribution}.

## Record

One CSV file per motion, a row per sample, SI units, all digits of the numbers:

    {header}

`time` in whole multiples of {h} s. A free body's quaternion is w x y z, its velocities (angular _wx _wy _wz, linear
_vx _vy _vz, of the body frame's origin) are both expressed in the world. `position.JOINT` and `velocity.JOINT` do for
joints of one degree of freedom. An MCAP file or bag of ROS 2 messages (sensor_msgs/JointState, nav_msgs/Odometry) does
too. Beside `run.csv` put `run.contract.json` with what is known of the engine:

    {{"engine": "...", "version": "...", "precision": "float32", "time step": {h}, "integrator": "...",
     "contact law": "...", "limit law": "...", "gravity": {gravity}, "seeds": [...], "reset distribution": "..."}}

What it does not say is reported as not told.

## Compare

    drake-diff compare MODEL --recording run.csv
"""
COMMON = """- time step {h} s, one step of the solver each; gravity {gravity} m/s^2
- integrator: {integrator}. If yours is another, say so in the contract
- contact: {contact_law}; friction and stiffness of each pair are in `contract.json`
- rotor inertia (`armature`), damping and springs of the joints as in `contract.json`: check that your reader took them
- forces on joints, no position or velocity drives; inputs: {inputs}"""
OF_TARGET: Mapping[str, str] = {
    "gazebo": """
- Gazebo reads no `drake:rotor_inertia`: where `contract.json` has an armature, it is missing there
- one physics step per update (`max_step_size` is in the file), real-time factor 0; friction of a pair is
  2 a b / (a + b) in Drake; the file has a number where all pairs have the same""",
    "isaaclab": """
- `UrdfConverterCfg`: fix_base where the model hangs on the world, merge_fixed_joints False, joint_drive target type
  none. Neither URDF nor the USD has friction and contact stiffness
- environment parity: sim.dt = {h}, decimation = 1, render_interval = 1, gravity {gravity}, no action scale or clip
- actuators: ImplicitActuatorCfg with stiffness 0, damping and armature of `contract.json`, effort limits as there
- solver: TGS, 32 position and 1 velocity iterations, or say which; no contact offset, no bounce (restitution 0),
  linear and angular damping of bodies 0, no limit of velocities
- friction: both sides of a pair the value of `contract.json`, friction_combine_mode "average"; restitution likewise
- reset: write_root_pose_to_sim, write_root_velocity_to_sim and write_joint_state_to_sim with exactly these states, no
  randomization events, no observation noise; log the seed all the same, and the reset distribution. Isaac Lab 3 has
  quaternions as x y z w, before it w x y z; the CSV has w x y z""",
}


def readme(
    target: str,
    file: str,
    model: Model,
    contract: EngineContract,
    made: Mapping[str, Any],
    left_out: Sequence[str],
    about_usd: str,
) -> str:
    """README.md of an export; `made` has count, seed and distribution of the states, `left_out` names geometries."""
    facts = {
        "h": repr(contract.time_step),
        "gravity": list(contract.gravity),
        "integrator": contract.integrator,
        "contact_law": contract.contact_law,
        "inputs": ", ".join(contract.inputs) or "none",
    }
    settings = (COMMON + OF_TARGET.get(target, "")).format(**facts)
    header = ",".join(["time", *model.state_names, *model.input_names])
    shapes = ", ".join(left_out) or "none"
    return README.format(
        name=model.name, target=target, file=file, settings=settings, header=header, left_out=shapes,
        about_usd=about_usd, **facts, **made,
    )  # fmt: skip

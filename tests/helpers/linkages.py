"""A leg with a closed loop: a crank on the trunk moves the knee by a rod."""

LEG = (
    '<mujoco model="leg"><worldbody><body name="trunk" pos="0 0 0.8">'
    '<inertial pos="0 0 0" mass="3" diaginertia="0.02 0.02 0.02"/>'
    '<joint name="rail" type="slide" axis="0 0 1" damping="1"/>'
    '<body name="thigh"><joint name="hip" axis="0 1 0" range="-60 60" damping="0.05" armature="0.01"/>'
    '<inertial pos="0 0 -0.12" mass="0.8" diaginertia="0.006 0.006 0.0005"/>'
    '<body name="shank" pos="0 0 -0.25"><joint name="knee" axis="0 1 0" range="-120 90"/>'
    '<inertial pos="0 0 -0.1" mass="0.4" diaginertia="0.003 0.003 0.0002"/></body></body>'
    '<body name="crank"><joint name="drive" axis="0 1 0" damping="0.05" armature="0.01"/>'
    '<inertial pos="0.02 0 0" mass="0.15" diaginertia="1e-4 1e-4 1e-4"/>'
    '<body name="rod" pos="0.05 0 0"><joint name="pin" axis="0 1 0"/>'
    '<inertial pos="0 0 -0.125" mass="0.1" diaginertia="5e-4 5e-4 1e-5"/></body></body></body></worldbody>'
    '<equality><connect body1="rod" body2="shank" anchor="0 0 -0.25"/></equality>'
    '<actuator><motor name="h" joint="hip" ctrlrange="-20 20"/><motor name="d" joint="drive" ctrlrange="-20 20"/>'
    '<motor name="r" joint="rail" ctrlrange="-100 100"/></actuator></mujoco>'
)

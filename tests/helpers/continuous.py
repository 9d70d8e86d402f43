"""The motion of a plant at time_step = 0 by Drake's error-controlled integration."""

from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig


def error_controlled_end(plant, diagram, duration):
    """Return a function from the start (nx,) of a motion to its end (nx,): Runge-Kutta 3 with an accuracy of 1e-8."""
    simulator = Simulator(diagram)
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.01, accuracy=1e-8, use_error_control=True
    )
    ApplySimulatorConfig(config, simulator)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())

    def end(x):
        simulator.get_mutable_context().SetTime(0.0)
        plant.SetPositionsAndVelocities(context, x)
        simulator.Initialize()
        simulator.AdvanceTo(duration)
        return plant.GetPositionsAndVelocities(context).copy()

    return end

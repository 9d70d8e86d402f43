"""The motion of a plant at time_step = 0 by Drake's error-controlled integration."""

from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig


def error_controlled_end(plant, diagram, duration):
    """Where the motion ends, (nx,), as a function of its start (nx,): Runge-Kutta 3 of accuracy 1e-8."""
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

"""One trial on disk: what it was, a trace of all that the loop saw and did, a replay beside the plan, its latencies."""

from pathlib import Path

import numpy as np

from drake_diff.arrays import Array
from drake_diff.loop.perturbation import Setup, perturbed
from drake_diff.loop.robustness_record import EventEvidence, TrialEvidence
from drake_diff.loop.trial import Outcome, Task, Trial
from drake_diff.parameters import applied, select
from drake_diff.record import canonical
from drake_diff.whole_file import write_whole

TRIAL, TRACE, REPLAY, LATENCIES = "trial.json", "trace.mcap", "replay.html", "latencies.json"
FURTHEST = 1e6  # m and rad: what runs away further is drawn there; the trace has it as it was
FILES = (TRIAL, TRACE, REPLAY, LATENCIES)


def write_trial(folder: Path, task: Task, trial: Trial, run: str | None) -> None:
    """Write all FILES of `trial` into `folder`; `run` is the directory that its plan is from, None where there is none.

    All but the latencies are the same, byte for byte, for the same trial.
    """
    from drake_diff.loop.trial_trace import write_trial_trace  # what saves nothing need not load them
    from drake_diff.meshcat_scene import BLUE, scene_of
    from drake_diff.meshcat_view import write_replay
    from drake_diff.trace_motion import Shown

    folder.mkdir(parents=True, exist_ok=True)
    evidence = trial_evidence(task, trial, run)
    write_whole(folder / TRIAL, canonical(evidence.model_dump(mode="json")).encode())
    latencies = {"budget_s": trial.outcome.run.latency_budget, "latencies_s": trial.outcome.run.latencies.tolist()}
    write_whole(folder / LATENCIES, canonical(latencies).encode())
    setup, motion = perturbed(task.setup, trial.levels, trial.seed), trial.outcome.run.motion
    planned = planned_states(task, setup)
    with applied(select(setup.model, setup.parameters)) as model:
        write_trial_trace(folder / TRACE, Shown(model, model.time_step, planned, motion), trial)
        xs, ghost = (np.clip(states, -FURTHEST, FURTHEST) for states in (motion.xs, planned))
        xs = xs if len(xs) > 1 else np.repeat(xs, 2, axis=0)  # it broke off at once
        times = np.asarray(model.time_step * np.arange(len(xs)), dtype=float)
        contacts = motion.contacts if len(motion.contacts) == len(xs) - 1 else ()
        scene = scene_of(model, times, xs, contacts=contacts, ghosts={"plan": (ghost[: len(xs)], BLUE)})
        far = f", drawn up to {FURTHEST:g} only" if np.any(np.abs(motion.xs) > FURTHEST) else ""
        title = f"{evidence.perturbation} {evidence.level:g}: {trial.label or 'success'}{far}"
        write_replay(folder / REPLAY, scene, title=title)


def planned_states(task: Task, setup: Setup) -> Array:
    """(n+1, nx) of the plan at each step of the plant of `setup`."""
    finer = round(task.model.time_step / setup.model.time_step)
    return np.asarray(task.plan.sample(task.parts * finer)[0])


def trial_evidence(task: Task, trial: Trial, run: str | None) -> TrialEvidence:
    """What trial.json says."""
    outcome, ((name, level), *_) = trial.outcome, trial.levels.items()
    setup = perturbed(task.setup, trial.levels, trial.seed)
    return TrialEvidence(
        run=run,
        controller=controller_name(task),
        perturbation=name,
        level=level,
        seed=trial.seed,
        success=outcome.success,
        label=trial.label,
        reason=trial.reason,
        failures=list(outcome.failures),
        goal_error=finite(outcome.goal_error),
        displacement=displacement_of(outcome),
        ended=outcome.run.ended,
        plant_time_step_s=setup.model.time_step,
        controller_period_s=setup.loop.substeps * setup.model.time_step,
        parameters={key: np.asarray(value).tolist() for key, value in setup.parameters.items()},
        start=setup.x0.tolist(),
        events=[EventEvidence(t_s=e.t, kind=e.kind, message=e.message) for e in outcome.run.events],
    )


def controller_name(task: Task) -> str:
    """What `Task` takes, or that it is none of ours."""
    return task.controller if isinstance(task.controller, str) else "a user's function"


def displacement_of(outcome: Outcome) -> float | None:
    """The length of the last state's displacement; None where the run broke off or it is not finite."""
    return None if outcome.run.ended else finite(float(np.linalg.norm(outcome.displacement)))


def finite(value: float) -> float | None:
    return value if np.isfinite(value) else None

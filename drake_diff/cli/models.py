"""Commands on a model file: audit, certify, compare, identify, excite, export-model; and certify-function."""

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_diff.cli.text import (
    Seed,
    as_options,
    conclude,
    floats_in,
    judged,
    names_in,
    names_option,
    numbers_in,
    out_option,
    plain,
    progress_line,
    repeated,
    show,
    show_table,
    show_written,
    split_pair,
    takes_model,
)
from drake_diff.derivatives import METHODS
from drake_diff.exceptions import InputError, UnknownNameError

GAPS = {"same": "green", "other law": "yellow", "other model": "red", "unexplained": "red"}
FINDINGS = {"error": "bold red", "warning": "bold yellow", "info": "bold dim"}


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    for command in (audit, certify, compare, identify, excite):
        app.command()(takes_model(command))
    app.command("export-model")(takes_model(export))
    app.command("certify-function")(certify_function)


def audit(model: Any, file: Path) -> None:
    """List problems of MODEL, such as parts that cannot be differentiated or have no motor, and remedies.

    Exit status 1 if a finding is an error.
    """
    from drake_diff.certificates.audit import audit as audit_model

    findings = audit_model(model)
    for finding in findings:
        show(plain(finding.severity, FINDINGS[finding.severity]), f"{finding.subject}: {finding.message}")
        show(plain("    remedy:", "dim"), finding.remedy)
        if finding.arguments:
            show(plain("    option:", "dim"), as_options(finding.arguments))
    errors, warnings, notes = (sum(f.severity == severity for f in findings) for severity in FINDINGS)
    show(f"{model.name}: {errors} errors, {warnings} warnings, {notes} notes")
    conclude(not errors)


def certify(
    model: Any,
    file: Path,
    states: Annotated[
        int, typer.Option(help="Number of states to sample, every second one in contact where possible.")
    ] = 20,
    seed: Seed = 0,
    parameters: Annotated[str | None, names_option("Parameters of additional derivatives", "none")] = None,
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")] = "auto",
    out: Annotated[Path | None, out_option("artifacts/certify_<model>")] = None,
) -> None:
    """Compare the derivatives of MODEL's step with finite differences, entry by entry, at sampled states.

    Writes record.json. Exit status 0 only if every certificate agrees.
    """
    from drake_diff.runs.certificates import certify_model

    directory = out or Path("artifacts") / f"certify_{file.stem}"
    show(plain(file.name, "bold"), f"{model}, contact {model.contract.contact.model}")
    names = tuple(names_in(parameters) or ())
    record: Any = certify_model(model, states=states, seed=seed, parameters=names, method=method, directory=directory)
    rows = []
    for i, state in enumerate(record.certification.states):
        modes, gradient = list(state.contact_modes.values()), state.gradient
        near = f", {len(state.mode_changes)} near" if state.mode_changes else ""
        contacts = ", ".join(f"{modes.count(mode)} {mode}" for mode in sorted(set(modes)))
        largest = "" if state.largest is None else f"{state.largest:.4g}"
        source = (gradient.method, f"{100 * gradient.power:.1g} %") if gradient else ("", "")
        verdict = plain(state.verdict + near, "green" if state.verdict == "agree" else "red")
        rows.append((i, state.kind, contacts, gradient.entries if gradient else "", largest, *source, verdict))
    show_table(("state", "motion", "contacts", "entries", "largest", "from", "noticed", "verdict"), rows)
    for i, state in enumerate(record.certification.states):
        if state.verdict != "agree":
            show(f"state {i}: {state.refusal or state.gradient.worst}")
            for change in state.mode_changes[:3]:
                show(f"    {change}")
    show(judged(record.verdict), f"{record.sentence}, {record.wall_clock.duration_s:.1f} s")
    show(f"wrote {directory / record.FILE}")
    conclude(record.verdict == "pass")


def certify_function(
    function: Annotated[str, typer.Argument(metavar="MODULE:FUNCTION", help="A function in a module of yours.")],
    x: Annotated[str, typer.Option(help="The point: numbers separated by commas, or the name of an array in MODULE.")],
    jacobian: Annotated[str | None, typer.Option(metavar="NAME", help="The function's Jacobian, in MODULE.")] = None,
    jvp: Annotated[str | None, typer.Option(metavar="NAME", help="Its products with tangents (x, v).")] = None,
    vjp: Annotated[str | None, typer.Option(metavar="NAME", help="Its products with cotangents (x, w).")] = None,
    scales: Annotated[str | None, typer.Option(help="Scales of the variables, as --x.")] = None,
    solver_tolerance: Annotated[float, typer.Option(help="Relative tolerance of a function solved iteratively.")] = 0.0,
) -> None:
    """Certify the derivative of a function of any engine, along random directions and then entry by entry.

    This imports MODULE, which runs its code. Exit status 0 only if the derivative agrees.
    """
    from drake_diff.certificates.functions import certify_function as certify_derivative

    name, _, attribute = function.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    missing = InputError("MODULE:FUNCTION", got=repr(function), expected="a module here or installed")
    if not name or name.startswith("."):
        raise missing

    def named(option: str, word: str | None) -> Any:
        if word is None or not all(inner.isidentifier() for inner in word.split(".")):
            return None if word is None else floats_in(option, word, "numbers separated by commas, or a name in MODULE")
        value = module
        for inner in word.split("."):
            if not hasattr(value, inner):
                raise UnknownNameError(option, got=inner, known=[key for key in dir(value) if not key.startswith("_")])
            value = getattr(value, inner)
        return value

    words = {"jacobian": jacobian, "jvp": jvp, "vjp": vjp, "scales": scales}
    try:
        module = import_module(name)
        given = {key: named(f"--{key}", word) for key, word in words.items()}
        f, point = named("MODULE:FUNCTION", attribute), named("--x", x)
        certificate = certify_derivative(f, point, **given, solver_tolerance=solver_tolerance)
    except ModuleNotFoundError as error:
        if not f"{name}.".startswith(f"{error.name}."):
            raise
        raise missing from error
    except SystemExit as end:  # whose status would be taken for the verdict
        got = f"sys.exit({end.code!r})"
        raise InputError("MODULE:FUNCTION", got=got, expected="code that does not end the process") from end
    show(judged(certificate.verdict), str(certificate).removeprefix(certificate.verdict).strip())
    conclude(certificate.verdict == "agree")


def compare(
    model: Any,
    file: Path,
    engines: Annotated[
        str | None, names_option("Engines to compare, such as mujoco or drake:lagged", "all installed")
    ] = None,
    recording: Annotated[
        list[Path] | None, typer.Option(help="A recorded motion to compare with Drake: CSV, MCAP or a ROS 2 bag.")
    ] = None,
    num_steps: Annotated[
        int | None, typer.Option(min=1, help="Length of the motion in steps.", show_default="one second")
    ] = None,
    seed: Seed = 0,
    out: Annotated[Path | None, out_option("artifacts/compare_<model>")] = None,
) -> None:
    """Simulate MODEL in every engine with the same masses, limits and time step, and explain the differences.

    If a recording differs, the smallest change of the model that explains it is reported, with its interval. Exit
    status 0 only if every engine agrees with Drake, or differs by a law that its contract states.
    """
    from drake_diff.comparison.files import PAGE, write_comparison
    from drake_diff.comparison.recordings import read_recording, with_own_names
    from drake_diff.comparison.side_by_side import compare as compare_engines
    from drake_diff.identification.recorded_causes import cause_of
    from drake_diff.runs.directory import written_whole

    directory = out or Path("artifacts") / f"compare_{file.stem}"
    recordings = with_own_names([read_recording(path, model) for path in recording or ()])
    with written_whole(directory) as folder:
        comparison = compare_engines(model, names_in(engines), recordings=recordings, num_steps=num_steps, seed=seed)
        apart = {e.engine for e in comparison.engines if e.verdict != "same"}
        causes = {motion.name: cause_of(model, motion) for motion in recordings if motion.name in apart}
        record = write_comparison(comparison, folder, causes=causes)
    clock, rows = record.wall_clock, []
    for i, e in enumerate(record.engines):
        times = (clock.seconds_per_step[e.engine], clock.seconds_per_jacobian[e.engine])
        answer = {"its own step's": "yes", "not its own step's": plain("no", "red")}.get(e.gradient, e.gradient)
        first = "" if e.first_apart_s is None else f"{e.first_apart_s:.4g} s"
        verdict = plain(e.verdict, GAPS[e.verdict]) if i else plain("reference", "dim")
        gaps = (f"{e.largest_step_gap:.1e}", first, f"{max((j.gap for j in e.jacobians), default=0.0):.1e}")
        rows.append((e.engine, verdict, *gaps, answer, *("-" if t is None else f"{1e6 * t:.0f} µs" for t in times)))
    columns = ("engine", "verdict", "step gap", "apart from", "Jacobian gap", "its own", "step", "Jacobian")
    show_table(columns, rows, wrap=False)
    for e in record.engines[1:]:
        show(plain(e.engine, "bold"), e.sentence)
        if e.cause is not None:
            show(plain(e.engine, "bold"), e.cause.sentence)
    for r in record.refused:
        show(plain(r.engine, "bold dim"), plain(f"not compared: {r.reason}", "dim"))
    show(judged(record.verdict), record.sentence)
    show(f"wrote {directory / PAGE}")
    conclude(record.verdict == "pass")


def identify(
    model: Any,
    file: Path,
    recording: Annotated[
        list[Path], typer.Option(help="A recorded motion: CSV, .npz, MCAP or a ROS 2 bag. Repeatable.")
    ],
    parameters: Annotated[str | None, names_option("Parameters to estimate", "all")] = None,
    noise: Annotated[list[str] | None, repeated("STATE=DEVIATION", "Standard deviation of a state's noise")] = None,
    held_out: Annotated[
        str,
        typer.Option(
            metavar="PART|NAME",
            help="Fraction at the end of each recording, or name of a recording, to predict instead of fit.",
        ),
    ] = "0.2",
    motion: Annotated[str, typer.Option(help="auto, continuous, steps or impacts")] = "auto",
    prior: Annotated[list[str] | None, repeated("PARAMETER=MEAN,DEVIATION", "Prior of a parameter")] = None,
    bounds: Annotated[list[str] | None, repeated("PARAMETER=LOWER,UPPER", "Bounds of a parameter")] = None,
    sensor: Annotated[
        list[str] | None, repeated("LABEL=BODY:X,Y,Z[,R,P,Y]", "Pose of a sensor in the frame of its body [m, rad]")
    ] = None,
    time_limit: Annotated[float | None, typer.Option(help="Time limit of the fit in seconds.")] = None,
    out: Annotated[Path | None, out_option("artifacts/identify_<model>")] = None,
) -> None:
    """Estimate parameters of MODEL from recordings, with confidence intervals, and list what cannot be identified.

    Writes record.json, the recordings, trace.mcap and report.html. Exit status 0 only if the estimated values explain
    the recordings.
    """
    from drake_diff.identification.files import write_identification
    from drake_diff.identification.identify import identify as estimate
    from drake_diff.runs.directory import written_whole

    directory = out or Path("artifacts") / f"identify_{file.stem}"
    names: Any = "all" if parameters is None else names_in(parameters)
    given = _deviations(noise)
    priors = numbers_in("--prior", prior or (), "PARAMETER=MEAN,DEVIATION", counts=(2,))
    limits = numbers_in("--bounds", bounds or (), "PARAMETER=LOWER,UPPER", counts=(2,))
    mounted = dict(_sensor_pose(word) for word in sensor or ())
    try:
        holdout: float | str = float(held_out)
    except ValueError:
        holdout = held_out
    asked: dict[str, Any] = {"noise": given, "held_out": holdout, "motion": motion, "sensors": mounted}
    with written_whole(directory) as folder:
        with progress_line("fitting", pause=5.0) as line:
            asked |= {"time_limit": time_limit, "callback": line}
            identification = estimate(model, list(recording), names, **asked, priors=priors, bounds=limits)
        record: Any = write_identification(identification, folder)
    show(judged(record.verdict), record.sentence)
    rows = []
    for e in record.estimates:
        known = e.lower is not None and e.upper is not None
        differs = known and not e.lower <= e.before <= e.upper
        remark = plain("not known", "dim") if not known else plain("differs", "yellow") if differs else ""
        rows.append((e.name, e.before, e.value, e.lower, e.upper, e.unit, remark))
    show_table(("parameter", "before", "found", "95 % from", "to", "unit", ""), rows, left=1)
    if record.rms and not record.explained:
        show_table(("rms error", "before", "after", "unit"), [(name, *e) for name, e in record.rms.items()], left=1)
    for line in record.remains:
        show(plain("remains", "bold dim"), line)
    for line in record.unidentifiable:
        show(plain("left open", "bold dim"), line)
    show(f"fitted: {record.motion}")
    show_written(directory, record)
    conclude(record.verdict == "pass")


def excite(
    model: Any,
    file: Path,
    parameters: Annotated[str | None, names_option("Parameters to identify", "all")] = None,
    duration: Annotated[float, typer.Option(help="Duration of the motion in seconds.")] = 5.0,
    period: Annotated[float, typer.Option(help="Time between samples in seconds; inputs change at samples.")] = 0.01,
    x0: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", show_default="the model's", help="Initial state at rest: numbers separated by commas."
        ),
    ] = None,
    noise: Annotated[
        list[str] | None, repeated("STATE=DEVIATION", "A measured state and the standard deviation of its noise")
    ] = None,
    limit: Annotated[list[str] | None, repeated("NAME=MOST|LOWER,UPPER", "Limits of a state or an input")] = None,
    harmonics: Annotated[int, typer.Option(help="Number of frequencies in the input signals.")] = 4,
    max_iterations: Annotated[
        int, typer.Option(min=0, help="Iterations of the search; 0 selects the best random motion.")
    ] = 20,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(dir_okay=False, help="CSV file to write, with motion and inputs.")] = None,
) -> None:
    """Find inputs for MODEL whose recording identifies its parameters, and predict the accuracy of each estimate.

    The file has the columns of a recording: time, states, inputs. Its states are the model's simulated motion.
    """
    import numpy as np

    from drake_diff.comparison.recordings import write_csv
    from drake_diff.identification.excite import excite as design

    if out is not None and out.suffix != ".csv":
        raise InputError("--out", got=str(out), expected="a .csv file")
    names: Any = "all" if parameters is None else names_in(parameters)
    limits = numbers_in("--limit", limit or (), "NAME=MOST or NAME=LOWER,UPPER", counts=(1, 2))
    asked: dict[str, Any] = {
        "x0": None if x0 is None else floats_in("--x0", x0, "numbers separated by commas"),
        "noise": _deviations(noise),
        "limits": {name: ends if len(ends) > 1 else ends[0] for name, ends in limits.items()} or None,
        "harmonics": harmonics,
        "max_iterations": max_iterations,
        "seed": seed,
    }
    with progress_line("searching"):
        excitation = design(model, names, duration=duration, period=period, **asked)
    show(excitation.sentence)
    rows = []
    for name, value in excitation.deviations.items():
        columns = [np.atleast_1d(deviations) for deviations in (value, excitation.random[name], excitation.rest[name])]
        for k, numbers in enumerate(zip(*columns, strict=True)):
            label = name if len(columns[0]) == 1 else f"{name}[{k}]"
            cells = (float(number) if np.isfinite(number) else "not known" for number in numbers)
            rows.append((label, *cells, excitation.units[name]))
    show_table(("parameter", "known to", "random", "at rest", "unit"), rows, left=1)
    for line in excitation.unidentifiable:
        show(plain("left open", "bold dim"), line)
    if out is not None:
        write_csv(excitation.recording(), model, out)
        show(f"wrote {out}")


def _deviations(noise: list[str] | None) -> dict[str, float] | None:
    return {name: n for name, (n,) in numbers_in("--noise", noise or (), "STATE=DEVIATION").items()} or None


def _sensor_pose(word: str) -> tuple[str, tuple[str, list[float]]]:
    expected = "LABEL=BODY:X,Y,Z or LABEL=BODY:X,Y,Z,ROLL,PITCH,YAW"
    label, value = split_pair("--sensor", word, expected)
    body, colon, numbers = value.rpartition(":")
    if not (body and colon):
        raise InputError("--sensor", got=repr(word), expected=expected)
    return label, (body, floats_in("--sensor", numbers, expected))


def export(
    model: Any,
    file: Path,
    to: Annotated[str, typer.Option(help="gazebo, isaaclab, urdf, sdf or mjcf")],
    out: Annotated[Path, typer.Option(help="Directory to write. It must not exist yet.")],
) -> None:
    """Write MODEL for an external engine: model file, contract, start states, and instructions for the recording."""
    from drake_diff.export.export import export_model

    show("wrote " + ", ".join(map(str, export_model(model, out, target=to))))

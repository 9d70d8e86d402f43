"""The command plan: from a robot file to a verified plan."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.live import Live
from rich.text import Text

from drake_diff._base.signals import INTERRUPTED
from drake_diff.cli.text import Seed, console, judged, out_option, plain, show, survived, table
from drake_diff.exceptions import InputError

EXAMPLE = "panda"  # what `drake-diff plan` alone plans for

Goals = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=NUMBERS", help="hand=0.4,0,0.5 for a frame or body, in metres, elbow=1.0 for a joint."),
]

Obstacles = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SHAPE:NUMBERS", help="sphere:x,y,z,radius or box:x,y,z,length,width,height in metres; repeatable."
    ),
]
NUMBERS = {"sphere": 4, "box": 6}


def add_commands(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command()(plan)


def plan(
    robot: Annotated[
        Path | None, typer.Argument(metavar="ROBOT", help="A URDF, SDF, MJCF (.xml) or .dmd.yaml file; else a Panda.")
    ] = None,
    goal: Goals = None,
    avoid: Obstacles = None,
    time: Annotated[str | None, typer.Option(help="least: as fast as can be; else with the least effort.")] = None,
    out: Annotated[Path | None, out_option("artifacts/plan_<robot>")] = None,
    seed: Seed = 0,
    restarts: Annotated[int, typer.Option(min=0, help="More first guesses, to list other optima.")] = 0,
) -> None:
    """Plan a motion of ROBOT: mend its file, solve, write the run directory and verify it.

    Without a goal it goes to a random state that the robot can reach. Exit status 0 only if the plan is verified.
    """
    goals = dict(_named_numbers(words) for words in goal or ())
    if len(goals) < len(goal or ()):
        raise InputError("--goal", got=" ".join(goal or ()), expected="each name once")
    shapes = [_shape(words) for words in avoid or ()]
    if robot is not None and not robot.is_file():
        raise InputError("ROBOT", got=str(robot), expected="a file that exists")
    # Only here: what is wrong is refused before Drake is loaded.
    from drake_diff.model.example import example_files
    from drake_diff.optimize.problem.obstacles import BoxObstacle, SphereObstacle
    from drake_diff.planning.planner import plan as planned
    from drake_diff.planning.robot import TIME_STEP

    obstacles = [SphereObstacle(n[:3], n[3]) if kind == "sphere" else BoxObstacle(n[:3], n[3:]) for kind, n in shapes]

    file = robot or example_files()[EXAMPLE]
    if robot is not None:
        survived(robot, {"time_step": TIME_STEP})
    try:
        with _live(file.name) as report:
            done = planned(
                file, goals=goals, avoid=obstacles, time=time, out=out, seed=seed, restarts=restarts, report=report
            )
    except KeyboardInterrupt as error:
        show("; ".join(("interrupted", *getattr(error, "__notes__", ()))))
        show("drake-diff recover measures the plan there, if there is one")
        raise typer.Exit(INTERRUPTED) from None
    show(judged("pass" if done.success else "fail"), f" {file.name}: {done.solution.status.value}")
    for line in done.lines:
        show(plain(line))
    raise typer.Exit(0 if done.success else 1)


def _shape(words: str) -> tuple[str, list[float]]:
    kind, colon, values = words.partition(":")
    expected = "sphere:x,y,z,radius or box:x,y,z,length,width,height"
    if not colon or kind not in NUMBERS:
        raise InputError("--avoid", got=repr(words), expected=expected)
    try:
        numbers = [float(value) for value in values.split(",")]
    except ValueError as error:
        raise InputError("--avoid", got=repr(words), expected=f"numbers with commas between: {expected}") from error
    if len(numbers) != NUMBERS[kind]:
        raise InputError("--avoid", got=repr(words), expected=f"{NUMBERS[kind]} numbers: {expected}")
    return kind, numbers


def _named_numbers(words: str) -> tuple[str, list[float]]:
    name, sign, values = words.rpartition("=")
    if not sign or not name:
        raise InputError("--goal", got=repr(words), expected="NAME=x,y,z of a frame, or NAME=number of a joint")
    try:
        return name.strip(), [float(value) for value in values.split(",")]
    except ValueError as error:
        raise InputError("--goal", got=repr(words), expected="numbers with commas between") from error


@contextmanager
def _live(name: str) -> Iterator[Callable[[str, str], None]]:
    """A table of the stages: rewritten on a terminal, a line for each stage elsewhere."""
    screen, begun, told = console(), dict[str, float](), dict[str, str]()
    shown = ""

    def now() -> Any:
        rows = table("stage", "seconds", "", wrap=False)
        stages = [*begun.items(), ("", time.monotonic())]
        for (stage, start), (_, end) in pairwise(stages):
            rows.add_row(plain(stage, "bold"), plain(f"{end - start:.1f}"), plain(told[stage][: screen.width - 24]))
        return rows

    def note(stage: str, sentence: str) -> None:
        told[stage] = sentence
        begun.setdefault(stage, time.monotonic())

    if not screen.is_terminal:

        def line(stage: str, sentence: str) -> None:
            nonlocal shown
            if stage != shown:
                screen.print(Text(f"{stage:9} "), plain(sentence), sep="")
            shown = stage

        yield line
        return
    with Live(get_renderable=now, console=screen, refresh_per_second=4, transient=True):
        yield note

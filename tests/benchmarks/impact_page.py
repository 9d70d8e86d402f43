"""docs/impacts.md from what impacts.py found, and what the scripts of other simulators and referees did."""

import math
import statistics

MORE = ("mjx", "newton", "nosnoc", "orders")
NAMES = {
    "drake": "AutoDiffXd through Drake's steps, 1 ms",
    "mujoco": "MuJoCo, central differences of mj_step, 2 ms",
    "mjx": "MJX, jax.jvp through mjx.step, 2 ms",
    "newton": "Newton, warp's tape through SolverSemiImplicit",
}


def told(found: int, of: int) -> str:
    """A share with its interval."""
    from rates import success_rate

    if not of:
        return "none of these"
    rate = success_rate(found, of)
    return f"{found} of {of} ({100 * rate.lower:.1f} to {100 * rate.upper:.1f} %)"


def table(heads: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows))


def percent(value: float) -> str:
    return f"{100 * value:.2g} %" if value < 10 else f"a factor of {value:.2g}"


def page(run: dict, more: dict) -> str:
    """The whole page."""
    import impacts

    cases = run["cases"]
    parts = [
        "# Gradients through random impacts\n",
        '`differentiate_rollout(..., method="continuous")` beside the truth, and beside other simulators. This page is '
        "written by\n",
        f"```sh\npython tests/benchmarks/impacts.py --seed {run['seed']} --count {run['count']} --out run.json\n"
        "python tests/benchmarks/impacts.py --page run.json\n```\n",
        *([CUT.format(len(cases), reached(cases))] if len(cases) < run["count"] else []),
        INTRODUCTION,
        table(["", "columns or cases (95 % Wilson interval)"], [[n, told(f, o)] for n, f, o in impacts.figures(cases)]),
        "\n## By family\n",
        families(cases),
        "\n" + failures(cases),
        "\n## Other simulators\n",
        PEERS,
        peers(cases, more),
        *(["\n### Derivatives by MJX\n", mjx(more["mjx"])] if "mjx" in more else []),
        "\n## How value and slope converge\n",
        CONVERGENCE,
        *([orders(more["orders"])] if "orders" in more else []),
        *(["\n## A second referee\n", nosnoc(more["nosnoc"])] if "nosnoc" in more else []),
    ]
    return "\n".join(part.strip("\n") + "\n" for part in parts)


def reached(cases: list[dict]) -> str:
    """Their numbers, as ranges."""
    numbers = sorted(int(one["name"].rsplit(".", 1)[1]) for one in cases)
    begins = [n for n in numbers if n - 1 not in numbers]
    ends = [n for n in numbers if n + 1 not in numbers]
    return ", ".join(f"{a} to {b}" if a != b else str(a) for a, b in zip(begins, ends, strict=True))


CUT = """
This run was cut short: it has {} of them, {}. What is dear, such as long tosses, which most often have no slope, is
missing more often than what is not.
"""

INTRODUCTION = """
Each case is drawn by seed from a formula (`tests/benchmarks/impact_cases.py`): balls that bounce, boxes with a sphere
in each corner that are tossed, slides with stick and slip, balls that slip until they roll, rods and pendulums that
strike the ground, two bodies that hit each other, balls thrown at a box, capsule, cylinder or sphere; by Hunt and
Crossley's law (`lagged`, `similar`) and by that of `sap`. Two or three columns of the gradient are judged in each: by
numbers of the first state, by friction, by the stiffness, by a constant input.

The truth is Drake's own continuous plant (`time_step = 0`, double) by error-controlled Runge-Kutta 3 of accuracy 1e-8,
and central differences over +-1e-2, +-1e-3 and +-1e-4. A slope *exists* where the three agree to 0.1 %. It is *narrow*
where the last two agree to 0.1 % and the first does not: a curve, or a graze nearby. Else there is *none*. Where the
last two nearly agree, and for the first column of each case, slopes were taken again at accuracy 1e-10, so that the
integration's own error is not taken for the loss's. For the law of `sap`, which no continuous plant of Drake's has, a
system of the benchmark pushes the bodies; without damping it is Drake's to rounding (`tests/test_impact_cases.py`).
"""

PEERS = """
The first column of each case that exists or is narrow; of some cases only, since they are dear. Drake's steps have the
case's own law, and their error is that from the truth above. MuJoCo and MJX have another law of contact (stiffness and
friction are matched, damping is their own): their error is that from MuJoCo's own motion in steps of 10 us, where its
slopes over +-1e-2 and +-3e-3 agree to 5 %. Elsewhere what it should be is not known, and it is not counted. MJX is
asked for the cases of the table below. Newton has the bounces whose loss is in the height, as a particle (its tape
holds contacts of rigid bodies fixed), and its error is that from its own law, a spring and a damper, in small steps.
"""

CONVERGENCE = """
![Errors of value and slope: along the flow they fall with the tolerance, in Drake's steps hardly](impacts_orders.png)

`tests/benchmarks/impact_orders.py` makes it. The ball bounces without loss, which has a closed form; the cube is that
of `tests/test_flow.py`, and its reference Drake's continuous plant at an accuracy of 1e-11. An order is the slope of a
line through log(error) over log(tolerance) or log(step):
"""


def families(cases: list[dict]) -> str:
    rows = []
    for family in dict.fromkeys(one["family"] for one in cases):
        own = [one for one in cases if one["family"] == family]
        columns = [c for one in own for c in one["columns"]]
        kinds = [[c for c in columns if c["kind"] == kind] for kind in ("exists", "narrow", "none")]
        exist = kinds[0]
        right = sum(c["right"] and not c["undefined"] for c in exist)
        costs = [one["cost"] for one in own if one.get("cost")]
        rows.append(
            [family, str(len(own)), " / ".join(str(len(kind)) for kind in kinds), f"{right} of {len(exist)}",
             " / ".join(str(sum(c["undefined"] for c in kind)) for kind in kinds),
             percent(statistics.median(c["error"] for c in exist)) if exist else "",
             f"{statistics.median(costs):.1f}, {max(costs):.1f}" if costs else ""]
        )  # fmt: skip
    heads = [
        "family", "cases", "exists / narrow / none", "given within 1 %", "called undefined, of each", "median error",
        "rollouts: median, most",
    ]  # fmt: skip
    return table(heads, rows)


def failures(cases: list[dict]) -> str:
    """Every one, by name."""
    lines = []
    for one in cases:
        if "failed" in one:
            lines.append(f"- {one['name']} ({one['law']}): {one['failed'].splitlines()[0]}")
        for c in one["columns"]:
            slopes = ", ".join(f"{s:.5g}" for s in c["slopes"])
            what = (
                f"- {one['name']} ({one['law']}), by {c['column']}: {c['kind']}, slopes {slopes}, ours {c['ours']:.5g}"
            )
            if c["kind"] == "exists" and c["undefined"]:
                lines.append(f"{what}, called undefined")
            elif c["kind"] == "exists" and not c["right"]:
                lines.append(f"{what}, off")
            elif c["kind"] == "none" and not c["undefined"]:
                lines.append(f"{what}, not called undefined")
            elif c["kind"] == "narrow" and not (c["undefined"] or c["right"]):
                lines.append(f"{what}, off and not called undefined")
    return "Every column that is not as it should be:\n\n" + "\n".join(lines) if lines else "No column is otherwise."


def peers(cases: list[dict], more: dict) -> str:
    """How near each comes to what its own motion does."""
    beside = {one["name"]: one for one in cases if one.get("peers")}
    answers: dict[str, list[dict]] = {"ours": []}
    for one in beside.values():
        first = one["columns"][0]
        ours = {"error": "undefined"} if first["undefined"] else {"slope": first["ours"], "wanted": first["slopes"][1]}
        answers["ours"].append(ours)
        for name, answer in one["peers"].items():
            answers.setdefault(name, []).append(answer)
    wanted = {name: one["peers"]["mujoco"].get("wanted") for name, one in beside.items()}
    if "mjx" in more:
        answers["mjx"] = [{"wanted": wanted.get(name)} | answer for name, answer in more["mjx"].items()]
    if "newton" in more:
        answers["newton"] = list(more["newton"].values())
    heads = ["", "cases", "within 1 %", "within 10 %", "wrong sign", "median error", "no number"]
    return table(heads, [row(name, found) for name, found in answers.items()])


def row(name: str, answers: list[dict]) -> list[str]:
    """Of one simulator."""
    numbers = [one for one in answers if "error" not in one and not math.isnan(one["slope"])]
    known = [(one["slope"], one["wanted"]) for one in numbers if one["wanted"]]
    errors = [abs(slope - wanted) / abs(wanted) for slope, wanted in known]
    return [
        NAMES.get(name, 'drake_diff, `method="continuous"`'),
        str(len(errors)),
        str(sum(error <= 0.01 for error in errors)),
        str(sum(error <= 0.1 for error in errors)),
        str(sum(slope * wanted < 0 for slope, wanted in known)),
        percent(statistics.median(errors)) if errors else "",
        str(len(answers) - len(numbers)),
    ]


def orders(found: dict) -> str:
    from impact_orders import order

    rows = []
    for name, laws in found.items():
        for law, one in laws.items():
            over = "tolerance" if law == "continuous" else "h"
            how = 'method="continuous"' if law == "continuous" else f"Drake's steps, {law}"
            numbers = [f"{order(one[over], one[what]):.1f}, {min(one[what]):.1g}" for what in ("value", "slope")]
            rows.append([name, how, f"{over}, {one[over][0]:g} to {one[over][-1]:g}", *numbers])
    return table(["", "", "over", "value: order, least error", "slope: order, least error"], rows)


def mjx(found: dict) -> str:
    rows = [
        [name, one.get("cone", "elliptic"), "no number" if one["slope"] != one["slope"] else f"{one['slope']:.5g}",
         f"{one['compile']:.0f} s", f"{one['run']:.2f} s"]
        for name, one in found.items() if "error" not in one
    ]  # fmt: skip
    return table(["case", "cone of friction", "slope", "compilation", "run"], rows)


REFEREE = """
nosnoc solves piecewise smooth systems with the moments of switching as unknowns (`tests/benchmarks/impact_nosnoc.py`,
in an environment of its own). It has Coulomb's friction as it is; ours has a stiction speed, 1e-3 m/s, and goes to
Coulomb's as that goes to 0. Value and slope of each motion's end:
"""


def nosnoc(found: dict) -> str:
    def both(pair: list[float]) -> str:
        return f"{pair[0]:.6g}, {pair[1]:.6g}"

    rows = []
    for name, told in REFEREED.items():
        ours = found["ours"][name].items()
        speeds = [both(pair) + (f" ({speed} m/s)" if float(speed) else "") for speed, pair in ours]
        rows.append([told, both(found["theirs"][name]), "<br>".join(speeds), both(found["exact"][name])])
    return REFEREE.strip("\n") + "\n\n" + table(["", "nosnoc", "ours (stiction speed)", "closed form"], rows)


REFEREED = {
    "slide": "a block slides to its stop, by its speed",
    "spring": "a block on a spring slips, turns and sticks, by where it begins",
    "bounce": "a ball bounces on a spring and damper whose force jumps at touch, by its speed",
}

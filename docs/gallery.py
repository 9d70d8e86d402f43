"""Build the gallery: run each example, verify its run, take a picture of the motion, and write the page.

    python docs/gallery.py              all examples, in half an hour
    python docs/gallery.py NAME ...     only these examples

The script needs Chromium, and selenium from the extra `test`. It writes the page and pictures to docs/gallery, and the
runs to docs/gallery/runs, which git ignores. A site that is built in the same checkout includes their reports.
"""

import base64
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import drake_diff as dd

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs/gallery"
LONGEST = 3600.0  # [s] time limit to verify a run
SIZE, QUALITY = (640, 400), 0.85  # size of a picture [pixels] and quality of its JPEG


class Entry(NamedTuple):
    """An example: name of its script, title, description, and time of its picture as a fraction of the motion."""

    name: str
    title: str
    text: str
    part: float
    writes: tuple[str, str] = ("", "")  # run and page below artifacts/, if the script writes them itself
    verdict: str = "pass"  # verdict in the run's record; "fail" can be the right verdict for a model of real data

    @property
    def run(self) -> str:
        """The run's directory, relative to the gallery's directory."""
        return f"runs/artifacts/{self.writes[0] or self.name}"

    @property
    def report(self) -> str:
        """The page that the picture links to, relative to the gallery's directory."""
        return f"runs/artifacts/{self.writes[1] or f'{self.name}/report.html'}"


ENTRIES = (
    Entry("cart_pole_swing_up", "Cart-pole", "A cart swings up its pole and stops 1 m further after 2 s.", 0.75),
    Entry("acrobot_swing_up", "Acrobot", "Two links with one actuator, at the elbow, swing up.", 0.8),
    Entry("crane_without_sway", "Crane", "A load moves 2 m in 3 s. Its rope sways by at most 0.14 rad.", 0.35),
    Entry("panda_around_a_ball", "Panda arm", "The hand reaches a position. All links avoid the ball by 3 cm.", 0.5),
    Entry("quadrotor_gates", "Quadrotor", "It flies through three gates, with propellers added to the file.", 0.5),
    Entry("bounce_into_target", "Bounce", "A ball bounces once and then flies through its target.", 0.85),
    Entry(
        "push_without_touching",
        "Push",
        "A pusher moves a ball to a goal. The initial guess does not touch it.",
        0.8,
    ),
    Entry("hop_from_standing", "Hopper", "It hops 0.5 m and lands. The initial guess stays on the ground.", 0.6),
    Entry("quadruped_jump", "Quadruped", "It jumps forward, with a schedule of its contacts.", 0.5),
    Entry(
        "tossed_cube",
        "Tossed cube",
        "Friction, size and stiffness of a real cube are identified from tosses. The record lists unexplained errors.",
        0.0,
        ("tossed_cube/impacts", "tossed_cube/impacts/report.html"),
        "fail",
    ),
    Entry("jumping_leg", "Co-design", "Lengths, spring and torques of a leg are optimized for a high jump.", 0.55),
    Entry(
        "pushed_cart_pole",
        "MPC under pushes",
        "Model predictive control under increasing pushes. The report shows the trials. `verify` reproduced the plan.",
        0.6,
        ("pushed_cart_pole", "pushed_cart_pole_trials/robustness.html"),
    ),
)


def build(entry: Entry, folder: Path) -> None:
    """Run an example, verify its run and take its picture, or raise RuntimeError if a step fails."""
    runs, run = folder / "runs", folder / entry.run
    runs.mkdir(parents=True, exist_ok=True)
    script = ROOT / "examples" / f"{entry.name}.py"
    command = [str(script)] if any(entry.writes) else ["-m", "drake_diff.cli.main", "run", str(script)]
    done = subprocess.run([sys.executable, *command], cwd=runs, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = (done.stdout + done.stderr)[-2000:]
        raise RuntimeError(f"{entry.name}: {' '.join(command)} ended with {done.returncode}: {said}")
    record = dd.load_record(run)
    if record.verdict != entry.verdict:
        raise RuntimeError(f"{entry.name}: the run says {record.verdict}, not {entry.verdict}: {record.sentence}")
    found = dd.verify(run, time_limit=LONGEST, memory_limit=4.0)
    if not found.holds:
        raise RuntimeError(f"{entry.name}: {found}")
    print(f"{entry.name}: {found}", flush=True)
    (folder / f"{entry.name}.jpg").write_bytes(picture(run / "report.html", entry.part))


def picture(report: Path, part: float) -> bytes:
    """Return a JPEG of a report's 3D view at a fraction of its motion, or of its first plots if it has no view."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service
    from selenium.webdriver.support.ui import WebDriverWait

    options = webdriver.ChromeOptions()
    for flag in ("--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader"):
        options.add_argument(flag)
    with webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver"))) as browser:
        browser.get(report.resolve().as_uri())
        ready = "return document.documentElement.dataset.ready === 'yes'"
        WebDriverWait(browser, 60).until(lambda b: b.execute_script(ready))
        if browser.execute_script("return !document.getElementById('view')"):
            browser.set_window_size(1100, 4000)  # so that the page needs no scrolling
            browser.execute_async_script("setTimeout(arguments[0], 1000)")  # wait for the layout of the plots
            place = "const r = document.querySelector('.plots').getBoundingClientRect(); return [r.x, r.y, r.width]"
            x, y, width = browser.execute_script(place)
            scale = SIZE[0] / width
            clip = {"x": x, "y": y, "width": width, "height": SIZE[1] / scale, "scale": scale}
            asked = {"format": "jpeg", "quality": round(100 * QUALITY), "clip": clip}
            return base64.b64decode(browser.execute_cdp_cmd("Page.captureScreenshot", asked)["data"])
        show = (
            "const [width, height, part] = arguments, view = document.getElementById('view'),"
            "  slider = document.getElementById('time');"
            "view.style.width = width + 'px'; view.style.height = height + 'px';"
            "view.contentWindow.dispatchEvent(new Event('resize'));"
            "slider.value = part * slider.max; slider.dispatchEvent(new Event('input'));"
        )
        browser.execute_script(show, *SIZE, part)
        browser.execute_async_script("setTimeout(arguments[0], 1000)")  # at least two frames on a slow machine
        draw = (
            "const viewer = document.getElementById('view').contentWindow.viewer; viewer.render();"
            "return viewer.renderer.domElement.toDataURL('image/jpeg', arguments[0])"
        )
        return base64.b64decode(browser.execute_script(draw, QUALITY).split(",")[1])


def page() -> str:
    """Return the gallery's page in Markdown."""
    cards = [
        f"-   ![{e.title}]({e.name}.jpg)<!-- {e.report} -->\n\n"
        f"    **{e.title}.** {e.text}\n\n    `examples/{e.name}.py`\n"
        for e in ENTRIES
    ]
    return INTRO + "\n".join(cards) + "\n</div>\n"


INTRO = """# Gallery

Each picture shows a run of a script. `drake-diff verify` reproduced every run. If this site was built with the runs,
click a picture to open its report.

```sh
drake-diff run examples/cart_pole_swing_up.py
python docs/gallery.py
```

The first command writes one run, with its report in `artifacts/cart_pole_swing_up/`. The second writes all runs and
this page. Then build the site.

<div class="grid cards" markdown>

"""


def main(names: list[str]) -> None:
    """Build the entries with these names, or all entries, and write the page."""
    if unknown := set(names) - {entry.name for entry in ENTRIES}:
        raise SystemExit(f"no such entry: {', '.join(sorted(unknown))}")
    for entry in ENTRIES:
        if not names or entry.name in names:
            build(entry, FOLDER)
    (FOLDER / "index.md").write_text(page())


if __name__ == "__main__":
    main(sys.argv[1:])

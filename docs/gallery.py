"""Build the gallery: run each example, verify its run, take a picture of the motion, and write the page.

    python docs/gallery.py              all of them: half an hour
    python docs/gallery.py NAME ...     these; the others stay as they are

It needs Chromium and selenium, of the extra `test`. Pages and pictures go to docs/gallery. The runs go to
docs/gallery/runs, which git leaves out: a site that is built here has their reports.
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
LONGEST = 3600.0  # [s] that making a run again may take
SIZE, QUALITY = (640, 400), 0.85  # of a picture [pixels], and of its JPEG


class Entry(NamedTuple):
    """An example: its script's name, what to call it, what is seen, and at which part of the motion its picture is."""

    name: str
    title: str
    text: str
    part: float
    writes: tuple[str, str] = ("", "")  # the run and the page, below artifacts/, of a script that writes them itself
    verdict: str = "pass"  # what the run's record says: real data may leave a model "fail", which is no less true

    @property
    def run(self) -> str:
        """The run's directory, below the gallery's."""
        return f"runs/artifacts/{self.writes[0] or self.name}"

    @property
    def report(self) -> str:
        """The page that the picture opens, below the gallery's directory."""
        return f"runs/artifacts/{self.writes[1] or f'{self.name}/report.html'}"


ENTRIES = (
    Entry("cart_pole_swing_up", "Cart-pole", "A cart swings its pole up and stops 1 m further, in 2 s.", 0.75),
    Entry("acrobot_swing_up", "Acrobot", "Two links, and a motor at the elbow only: from hanging to standing.", 0.8),
    Entry("crane_without_sway", "Crane", "A load goes 2 m in 3 s; its rope may sway by 0.14 rad at most.", 0.35),
    Entry("panda_around_a_ball", "Panda arm", "Its hand reaches a place; no link comes near the ball.", 0.5),
    Entry("quadrotor_gates", "Quadrotor", "Three gates in 3 s, with propellers that the model file lacks.", 0.5),
    Entry("bounce_into_target", "Bounce", "A ball bounces once and flies through its target.", 0.85),
    Entry(
        "push_without_touching",
        "Push",
        "A ball is pushed to where it should be, from a guess that never touches it.",
        0.8,
    ),
    Entry("hop_from_standing", "Hopper", "It hops half a metre and lands, from a guess that stays on the ground.", 0.6),
    Entry("quadruped_jump", "Quadruped", "It jumps forward, from a schedule of which foot stands when.", 0.5),
    Entry(
        "tossed_cube",
        "Tossed cube",
        "A real cube's friction, size and stiffness from its tosses. Its record says what they leave unexplained.",
        0.0,
        ("tossed_cube/impacts", "tossed_cube/impacts/report.html"),
        "fail",
    ),
    Entry("jumping_leg", "Co-design", "The lengths of a leg, its spring and its torques, for a high jump.", 0.55),
    Entry(
        "pushed_cart_pole",
        "MPC under pushes",
        "Model predictive control, pushed harder and harder. The report has its trials; `verify` made its plan again.",
        0.6,
        ("pushed_cart_pole", "pushed_cart_pole_trials/robustness.html"),
    ),
)


def build(entry: Entry, folder: Path) -> None:
    """Run an example, verify what it wrote, and take its picture. RuntimeError where that does not succeed."""
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
    """A JPEG of the 3D view of a report at a part of its motion; of its first plots where it has no view."""
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
            browser.set_window_size(1100, 4000)  # so that nothing is scrolled
            browser.execute_async_script("setTimeout(arguments[0], 1000)")  # until the plots are laid out
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
        browser.execute_async_script("setTimeout(arguments[0], 1000)")  # two frames and more, on a slow machine
        draw = (
            "const viewer = document.getElementById('view').contentWindow.viewer; viewer.render();"
            "return viewer.renderer.domElement.toDataURL('image/jpeg', arguments[0])"
        )
        return base64.b64decode(browser.execute_script(draw, QUALITY).split(",")[1])


def page() -> str:
    """The gallery's Markdown."""
    cards = [
        f"-   ![{e.title}]({e.name}.jpg)<!-- {e.report} -->\n\n"
        f"    **{e.title}.** {e.text}\n\n    `examples/{e.name}.py`\n"
        for e in ENTRIES
    ]
    return INTRO + "\n".join(cards) + "\n</div>\n"


INTRO = """# Gallery

Each picture shows a run of a short script. `drake-diff verify` reproduced every run. If this site was built with the
runs, a picture opens the report.

```sh
drake-diff run examples/cart_pole_swing_up.py
python docs/gallery.py
```

The first command makes one run, with its report in `artifacts/cart_pole_swing_up/`. The second makes all of them,
and this page. Build the site after it.

<div class="grid cards" markdown>

"""


def main(names: list[str]) -> None:
    """Build the entries of these names, or all, and the page."""
    if unknown := set(names) - {entry.name for entry in ENTRIES}:
        raise SystemExit(f"no such entry: {', '.join(sorted(unknown))}")
    for entry in ENTRIES:
        if not names or entry.name in names:
            build(entry, FOLDER)
    (FOLDER / "index.md").write_text(page())


if __name__ == "__main__":
    main(sys.argv[1:])

"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const frame = byId("view"), slider = byId("time"), now = byId("now"), play = byId("play");
  const timed = [];  // the plots over time
  let time = 0, playing = false, last = 0;

  const viewer = () => frame && frame.contentWindow && frame.contentWindow.viewer;
  function isReady() {
    const v = viewer();
    return Boolean(v && v.animator && v.animator.actions.length);
  }
  function whenReady(act, tries = 200) {
    if (isReady()) act();
    else if (tries) setTimeout(() => whenReady(act, tries - 1), 50);
  }
  function pose() {
    if (!isReady()) return;
    const animator = viewer().animator;
    animator.seek(Math.min(time, animator.duration - 1e-6));
    viewer().render();
  }
  function setTime(t, from) {
    time = Math.min(Math.max(t, 0), data.duration);
    slider.value = time;
    now.textContent = time.toFixed(3) + " s";
    for (const u of timed) if (u !== from) u.setCursor({ left: u.valToPos(time, "x"), top: -10 }, false);
    for (const u of timed) if (u !== from) u.setLegend({ idx: nearest(u.data[0], time) }, false);
    pose();
  }
  function nearest(xs, x) {
    let low = 0, high = xs.length - 1;
    while (high - low > 1) { const mid = (low + high) >> 1; if (xs[mid] <= x) low = mid; else high = mid; }
    return x - xs[low] <= xs[high] - x ? low : high;
  }
  function advance(stamp) {
    if (!playing) return;
    const next = time + (last ? (stamp - last) / 1000 : 0);
    last = stamp;
    setTime(next > data.duration ? 0 : next);
    requestAnimationFrame(advance);
  }
  function setPlaying(on) {
    playing = on; last = 0; play.textContent = on ? "❚❚" : "▶";
    if (on) requestAnimationFrame(advance);
  }

  const shorten = (v) => v === null || v === undefined ? "–" : Math.abs(v) >= 1e5 || (v && Math.abs(v) < 1e-3)
    ? v.toExponential(1) : String(Number(v.toPrecision(4)));
  function decades(low, high) {  // whole powers of ten, sixteen of them at most
    if (!(high > 0)) return [1e-3, 1];
    const top = Math.ceil(Math.log10(high) + 1e-9), bottom = Math.floor(Math.log10(Math.max(low, high * 1e-16)));
    return [10 ** Math.min(bottom, top - 1), 10 ** top];
  }
  const levels = (xs) => () => [xs[0] / 1.3, xs[xs.length - 1] * 1.3];
  function powers(low, high) {  // of ten, six of them at most
    const first = Math.round(Math.log10(low)), last = Math.round(Math.log10(high));
    const apart = Math.max(1, Math.ceil((last - first) / 5));
    return Array.from({ length: Math.floor((last - first) / apart) + 1 }, (_, k) => 10 ** (first + k * apart));
  }
  function range(plot) {
    return (u, low, high) => {
      if (plot.range) return plot.range;
      if (plot.log) return decades(low, high);
      if (low === null || (low === 0 && high === 0)) return [0, 1];
      const span = Math.max(high - low, Math.abs(high) * 1e-3, 1e-12);
      for (const limit of plot.limits)  // a limit far away says nothing of the motion
        if (limit !== null && limit - high < 2 * span && low - limit < 2 * span) {
          low = Math.min(low, limit); high = Math.max(high, limit);
        }
      const margin = 0.08 * Math.max(high - low, span);
      return [low - margin, high + margin];
    };
  }
  function shade(plot) {
    return (u) => {
      const { left, top, width, height } = u.bbox, [lower, upper] = plot.limits;
      const at = (v) => Math.min(Math.max(u.valToPos(v, "y", true), top), top + height);
      u.ctx.save();
      u.ctx.fillStyle = colour("shade");
      if (upper !== null) u.ctx.fillRect(left, top, width, at(upper) - top);
      if (lower !== null) u.ctx.fillRect(left, at(lower), width, top + height - at(lower));
      u.ctx.restore();
    };
  }
  function draw(plot) {
    const box = document.createElement("div"), title = document.createElement("h3"), unit = document.createElement("span");
    box.className = "plot";
    title.textContent = plot.title + " ";
    unit.textContent = "[" + plot.unit + "]";
    title.append(unit);
    box.append(title);
    byId(plot.place).append(box);
    const solid = plot.series.filter((s) => !s.dashed).length;
    const axis = { stroke: () => colour("soft"), grid: { stroke: () => colour("line"), width: 1 },
      ticks: { stroke: () => colour("line"), width: 1 }, font: "11px system-ui, sans-serif" };
    const options = {
      width: Math.max(box.clientWidth, 200), height: 190,
      cursor: { y: false, drag: { x: false, y: false }, points: { size: 6 } },
      scales: { x: { time: false, distr: plot.levels ? 3 : 1, range: plot.levels ? levels(plot.x) : undefined }, y: { range: range(plot), distr: plot.log ? 3 : 1 } },
      legend: { live: plot.marks !== "points" },
      bands: plot.band ? [{ series: [plot.series.length, plot.series.length - 1], fill: () => colour("s0") + "33" }] : [],
      axes: [{ ...axis, size: 30, ...(plot.levels ? { splits: () => plot.x, filter: (u, all) => all, values: (u, all) => all.map(shorten) } : {}) }, { ...axis, size: 58, values: (u, ticks) => ticks.map((v) => v === null ? "" : shorten(v)),
        ...(plot.log ? { splits: (u, i, low, high) => powers(low, high), filter: (u, ticks) => ticks } : {}) }],
      series: [{ label: plot.axis === "time" ? "t [s]" : plot.axis, value: (u, v) => shorten(v) }].concat(
        plot.series.map((s, i) => ({ label: s.name, stroke: () => colour("s" + (plot.band ? 0 : s.dashed ? i - solid : i) % 6), width: 1.8,
          dash: s.dashed ? [6, 4] : [], paths: plot.marks === "points" ? () => null
            : s.held ? uPlot.paths.stepped({ align: 1 }) : undefined,
          points: { show: plot.marks === "lines" ? plot.x.length < 3 : !(plot.band && s.dashed), size: 6 }, value: (u, v) => shorten(v) }))),
      hooks: { drawClear: [shade(plot)], setCursor: [(u) => follow(u)] },
    };
    const values = plot.series.map((s) => plot.log ? s.y.map((v) => v > 0 ? v : null) : s.y);
    const u = new uPlot(options, [plot.x, ...values], box);
    if (plot.axis === "time") timed.push(u);
    if (plot.note) {
      const note = document.createElement("p");
      note.className = "note";
      note.textContent = plot.note;
      box.append(note);
    }
    new ResizeObserver(() => { if (box.clientWidth && box.clientWidth !== u.width)
      u.setSize({ width: box.clientWidth, height: 190 }); }).observe(box);
    plots.push(u);
  }
  const plots = [];
  function follow(u) {
    if (!timed.includes(u)) return;
    if (u.cursor.left >= 0 && u.cursor.event) { setPlaying(false); setTime(u.posToVal(u.cursor.left, "x"), u); }
    else if (u.cursor.left < 0) setTimeout(() => setTime(time), 0);  // the mouse has left: back to the time
  }

  const SIGNS = ["", "?", "~", "×", "!"];
  const svg = (name, attributes, text) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const key in attributes) node.setAttribute(key, attributes[key]);
    if (text !== undefined) node.textContent = text;
    return node;
  };
  function map(c, number) {
    const box = document.createElement("div"), title = document.createElement("h3"), told = document.createElement("p");
    box.className = "map";
    title.textContent = number + ": " + c.subject + " – " + c.verdict;
    const m = c.rows.length, n = c.columns.length;
    const picture = svg("svg", { viewBox: `0 0 ${n} ${m}`, role: "img", preserveAspectRatio: "xMinYMin", "aria-label": title.textContent });
    const say = (k) => {
      const i = Math.floor(k / n), j = k % n;
      told.textContent = `d ${c.rows[i]} / d ${c.columns[j]}: derivative ${c.derivative[k]}, differences ` +
        `${c.difference[k]}, tolerance ${shorten(c.tolerance[k])}, would have noticed ${shorten(c.noticeable[k])}: ${data.verdicts[c.codes[k]]}`;
    };
    c.codes.forEach((code, k) => {
      const x = k % n, y = Math.floor(k / n), cell = svg("rect", { x, y, width: 1, height: 1, fill: `var(--v${code})` });
      cell.addEventListener("pointerenter", () => say(k));
      picture.append(cell);
      if (code) picture.append(svg("text", { x: x + 0.5, y: y + 0.5, class: "sign", "pointer-events": "none" }, SIGNS[code]));
    });
    told.textContent = `${m} rows: ${c.rows.join(", ")}. ${n} columns: ${c.columns.join(", ")}.`;
    picture.style.maxWidth = 28 * n + "px";
    box.append(title, picture, told);
    return box;
  }
  function drawMaps() {
    const maps = byId("maps");
    if (!maps) return;
    const key = document.createElement("div");
    key.className = "key";
    data.verdicts.forEach((name, i) => {
      const item = document.createElement("span"), square = document.createElement("i");
      square.style.background = `var(--v${i})`;
      item.append(square, (SIGNS[i] + " " + name.replace("_", " ")).trim());
      key.append(item);
    });
    maps.before(key);
    data.certificates.forEach((c, i) => maps.append(map(c, i)));
  }

  data.plots.forEach(draw);
  drawMaps();
  if (slider) {
    slider.addEventListener("input", () => { setPlaying(false); setTime(Number(slider.value)); });
    play.addEventListener("click", () => setPlaying(!playing));
    setTime(0);
  }
  byId("download").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([byId("record").textContent], { type: "application/json" }));
    link.download = "record.json";
    link.click();
  });
  if (!frame) document.documentElement.dataset.ready = "yes";  // a page without a motion
  else whenReady(() => {
    const v = viewer();
    v.gui.domElement.style.display = "none";  // the slider is the page's own
    v.animator.play();
    v.animator.pause();
    setTime(time);
    document.documentElement.dataset.ready = "yes";
  });
  const redraw = () => plots.forEach((u) => u.redraw(false, true));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  addEventListener("beforeprint", () => {
    document.documentElement.classList.add("printed");
    redraw();
    if (!isReady()) return;
    viewer().render();
    byId("still").src = viewer().renderer.domElement.toDataURL("image/png");
  });
  addEventListener("afterprint", () => { document.documentElement.classList.remove("printed"); redraw(); });
})();

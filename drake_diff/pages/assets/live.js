"use strict";
(() => {  // a search as it goes on: its rows are asked for twice a second, and all text is text
  const byId = (id) => document.getElementById(id), PERIOD = 500;
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const SEEN = {
    searching: "Some states of the motion that the search stands at. The solid robot is the last of them.",
    ended: "The motion of the plan, as it was simulated.",
  };
  const PILLS = { pass: "pass", fail: "fail" };
  let known = { number: 0 }, rows = [], starts = [], plots = [];

  function make(tag, attributes, ...inside) {
    const node = document.createElement(tag);
    for (const key in attributes) node.setAttribute(key, attributes[key]);
    node.append(...inside);
    return node;
  }
  const short = (v) => v === null || v === undefined ? "–" : String(Number(v.toPrecision(4)));
  function decades(low, high) {
    if (!(high > 0)) return [1e-3, 1];
    const top = Math.ceil(Math.log10(high) + 1e-9), bottom = Math.floor(Math.log10(Math.max(low, high * 1e-16)));
    return [10 ** Math.min(bottom, top - 1), 10 ** top];
  }
  function powers(low, high) {  // of ten, six of them at most
    const first = Math.round(Math.log10(low)), final = Math.round(Math.log10(high)), apart = Math.max(1, Math.ceil((final - first) / 5));
    return Array.from({ length: Math.floor((final - first) / apart) + 1 }, (_, k) => 10 ** (first + k * apart));
  }
  function starting(u) {  // where another search of a chain begins
    const { top, height } = u.bbox;
    u.ctx.save();
    u.ctx.strokeStyle = colour("edge"); u.ctx.setLineDash([4, 4]); u.ctx.lineWidth = devicePixelRatio;
    for (const k of starts) if (k > 0) {
      const x = u.valToPos(k + 1, "x", true);
      u.ctx.beginPath(); u.ctx.moveTo(x, top); u.ctx.lineTo(x, top + height); u.ctx.stroke();
    }
    u.ctx.restore();
  }
  const columnOf = (i) => rows.map((row) => row[i]);
  function draw() {
    const x = rows.map((_, k) => k + 1);
    for (const plot of plots) {
      const all = columnOf(plot.column), log = plot.log || all.every((v) => v === null || v > 0);
      const y = log ? all.map((v) => v > 0 ? v : null) : all, found = [x, y];
      plot.value.textContent = short(all[all.length - 1]);
      if (!x.length) continue;
      if (plot.u && plot.isLog === log) { plot.u.setData(found); continue; }
      if (plot.u) plot.u.destroy();
      plot.isLog = log;
      const axis = { stroke: colour("soft"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") }, font: "12px system-ui" };
      plot.u = new uPlot({
        width: plot.place.clientWidth, height: 190, legend: { show: false }, cursor: { drag: { x: false, y: false } },
        scales: { x: { time: false }, y: log ? { distr: 3, range: (u, low, high) => decades(low, high) } : {} },
        axes: [{ ...axis, label: "iterations, as the solver tells of them", labelSize: 16, labelFont: "12px system-ui", size: 34, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000] },
          { ...axis, size: 64, ...(log ? { splits: (u, i, low, high) => powers(low, high), filter: (u, splits) => splits } : {}), values: (u, ticks) => ticks.map((v) => v === null ? "" : log ? v.toExponential(0).replace("e+", "e") : short(v)) }],
        series: [{}, { stroke: colour("s" + plot.column), width: 2, points: { show: rows.length < 40 } }],
        hooks: { draw: [starting] },
      }, found, plot.place);
    }
  }
  function restart() {
    rows = []; plots = [];
    byId("plots").replaceChildren();
    for (const [column, title, note, log] of [[0, "Cost", "", false], [1, "Violation", "the largest of any bound, goal or constraint; 0 is not on a log scale", true]]) {
      const value = make("b", {}), place = make("div", {});
      byId("plots").append(make("div", { class: "plot" }, make("div", { class: "head" }, make("h4", {}, title), value), place, make("p", { class: "note" }, note)));
      plots.push({ column, value, place, log });
    }
  }
  function explain(colours) {
    byId("colours").replaceChildren(...colours.map(([css, kind, words]) => {
      const sign = make("i", { class: kind });
      sign.style.color = css;
      return make("li", {}, sign, words);
    }));
  }
  function show(told) {
    const isNew = told.number !== known.number;
    if (isNew) restart();
    if (told.colours && String(told.colours) !== String(known.colours)) explain(told.colours);
    starts = told.starts;
    rows = rows.slice(0, told.first).concat(told.rows);
    const words = told.verdict ? told.state.replaceAll("_", " ") : told.state;
    document.title = told.title ? `${words}: ${told.title}` : "drake_diff";
    byId("title").textContent = told.title || "";
    byId("state").textContent = words || "waiting";
    byId("state").className = "pill " + (PILLS[told.verdict] || "incomplete");
    const [first, ...others] = (told.message || "").split("; ");
    byId("message").textContent = first;
    byId("more").hidden = !others.length;
    byId("more").lastElementChild.replaceChildren(...others.map((words) => make("li", {}, words)));
    const past = told.seconds === undefined ? "" : `${told.seconds.toFixed(1)} s`;
    byId("line").textContent = told.verdict ? `${rows.length} iterations in all, ${past}` : [past, told.line].filter(Boolean).join("  ·  ");
    byId("seen").textContent = told.verdict ? SEEN.ended : SEEN.searching;
    if (isNew || told.rows.length) draw();
    known = told;
    document.documentElement.dataset.rows = rows.length;
  }
  // The motion at the end, in the viewer's frame
  const animator = () => { const v = byId("view").contentWindow.viewer; return known.verdict && v && v.animator && v.animator.duration ? v.animator : null; };
  let shown = null, time = 0, last = 0, playing = true;
  function setTime(t) {
    time = t > shown.duration ? 0 : t;
    byId("time").value = time;
    byId("now").textContent = time.toFixed(3) + " s";
    shown.seek(Math.min(time, shown.duration - 1e-6));
    byId("view").contentWindow.viewer.render();
  }
  function setPlaying(on) {
    playing = on;
    byId("play").textContent = on ? "❚❚" : "▶";
    byId("play").setAttribute("aria-label", on ? "pause" : "play");
  }
  function advance(stamp) {
    const found = animator();
    byId("player").hidden = !found;
    if (found && (found !== shown || byId("time").max !== String(found.duration))) {
      byId("time").max = found.duration;
      shown = found; time = 0;
      setPlaying(!matchMedia("(prefers-reduced-motion: reduce)").matches);
    }
    if (found) { found.pause(); if (playing) setTime(time + (stamp - last) / 1000); }
    last = stamp;
    requestAnimationFrame(advance);
  }
  byId("play").addEventListener("click", () => setPlaying(!playing));
  byId("time").addEventListener("input", () => { setPlaying(false); if (shown) setTime(Number(byId("time").value)); });
  requestAnimationFrame(advance);

  async function ask() {
    let wait = PERIOD;
    try {
      const answer = await fetch(`news?number=${known.number}&known=${rows.length}`, { cache: "no-store" });
      show(await answer.json());
    } catch {
      if (!(known.verdict)) byId("state").textContent = "the process has ended";
      byId("line").textContent = "The process that searched has ended: this is what it showed last.";
      wait = 10 * PERIOD;
    }
    setTimeout(ask, wait);
  }
  addEventListener("resize", () => { for (const plot of plots) if (plot.u) plot.u.setSize({ width: plot.place.clientWidth, height: 190 }); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { for (const plot of plots) if (plot.u) { plot.u.destroy(); plot.u = null; } draw(); });
  ask();
})();

"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  for (const plot of data.plots) plot.x = data.xs[plot.x];
  const byId = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const frame = byId("view"), slider = byId("time"), now = byId("now"), play = byId("play"), speed = byId("speed");
  const drawn = [];  // every uPlot, with its `plot` and the element of its values
  let time = 0, playing = false, last = 0, subtracting = false;

  function make(tag, attributes, ...inside) {  // names are text, never markup
    const node = document.createElement(tag);
    for (const key in attributes) node.setAttribute(key, attributes[key]);
    node.append(...inside);
    return node;
  }
  function save(name, text, type) {
    const link = make("a", { download: name });
    link.href = URL.createObjectURL(new Blob([text], { type }));
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  // The replay, in its frame
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
  const isSeen = (u) => u.root.offsetParent !== null;
  function setTime(t, from) {
    time = Math.min(Math.max(t, 0), data.duration);
    if (slider) {
      slider.value = time;
      slider.setAttribute("aria-valuetext", time.toFixed(3) + " s");
      now.textContent = time.toFixed(3) + " s";
    }
    for (const u of drawn) if (u.plot.axis === "time" && isSeen(u)) {
      if (u !== from) u.setCursor({ left: u.valToPos(time, "x"), top: -10 }, false);
      tell(u, nearest(u.plot.x, time));
    }
    pose();
  }
  function nearest(xs, x) {
    let low = 0, high = xs.length - 1;
    while (high - low > 1) { const mid = (low + high) >> 1; if (xs[mid] <= x) low = mid; else high = mid; }
    return x - xs[low] <= xs[high] - x ? low : high;
  }
  function advance(stamp) {
    if (!playing) return;
    const next = time + (last ? Number(speed.value) * (stamp - last) / 1000 : 0);
    last = stamp;
    setTime(next > data.duration ? 0 : next);
    requestAnimationFrame(advance);
  }
  function setPlaying(on) {
    if (!play || playing === on) return;
    playing = on; last = 0; play.textContent = on ? "❚❚" : "▶";
    play.setAttribute("aria-label", on ? "pause" : "play");
    if (on) requestAnimationFrame(advance);
  }

  // Numbers and axes
  const HUES = 8;  // colours of lines
  const power = (text) => text.replace(/\.0+(?=e)/, "").replace("e+", "e");
  const shorten = (v) => v === null || v === undefined ? "–" : Math.abs(v) >= 1e5 || (v && Math.abs(v) < 1e-3)
    ? power(v.toExponential(1)) : String(Number(v.toPrecision(4)));
  function marked(ticks) {  // the numbers of an axis: no two of them the same
    const known = ticks.filter((v) => v !== null), apart = known.length > 1 ? Math.abs(known[1] - known[0]) : 0;
    const digits = apart > 0 ? Math.ceil(-Math.log10(apart) + 1e-9) : 0, most = Math.max(...known.map(Math.abs));
    const plain = digits > 3 && digits < 8 && most < 1e3 && most >= 10 * apart;
    return ticks.map((v) => v === null ? "" : plain ? v.toFixed(digits) : shorten(v));
  }
  function room(u, values) {  // for the widest number of an axis and its label
    const widest = (values || []).reduce((most, text) => Math.max(most, String(text).length), 0);
    return Math.max(48, 19 + 5.8 * widest);
  }
  function decades(low, high) {  // whole powers of ten, sixteen of them at most
    if (!(high > 0)) return [1e-3, 1];
    const top = Math.ceil(Math.log10(high) + 1e-9), bottom = Math.floor(Math.log10(Math.max(low, high * 1e-16)));
    return [10 ** Math.min(bottom, top - 1), 10 ** top];
  }
  const levels = (xs) => () => [xs[0] / 1.3, xs[xs.length - 1] * 1.3];
  function powers(low, high) {  // of ten, six of them at most
    const first = Math.round(Math.log10(low)), final = Math.round(Math.log10(high));
    const apart = Math.max(1, Math.ceil((final - first) / 5));
    return Array.from({ length: Math.floor((final - first) / apart) + 1 }, (_, k) => 10 ** (first + k * apart));
  }
  function nearLimits(plot, low, high) {  // a limit far away says nothing of the motion
    const span = Math.max(high - low, Math.abs(high) * 1e-3, 1e-12);
    return limitsOf(plot).map((v) => v !== null && v - high < 2 * span && low - v < 2 * span ? v : null);
  }
  function range(plot) {
    return (u, low, high) => {
      if (plot.range) return plot.range;
      if (plot.log) return decades(low, high);
      if (low === null || (low === 0 && high === 0)) return [0, 1];
      if (high - low <= 1e-9 * Math.abs(high)) { const v = high, half = Math.abs(v) / 2; low = v - half; high = v + half; }
      const near = nearLimits(plot, low, high).filter((v) => v !== null);
      const span = Math.max(high - low, Math.abs(high) * 1e-3, 1e-12);
      low = Math.min(low, ...near); high = Math.max(high, ...near);
      const margin = 0.08 * Math.max(high - low, span);
      return [low - margin, high + margin];
    };
  }
  function drawLimits(plot) {
    return (u) => {
      const { left, top, width, height } = u.bbox, [lower, upper] = limitsOf(plot);
      const y = (v) => Math.min(Math.max(u.valToPos(v, "y", true), top), top + height);
      u.ctx.save();
      u.ctx.fillStyle = colour("shade"); u.ctx.strokeStyle = colour("limit");
      u.ctx.setLineDash([7, 4]); u.ctx.lineWidth = devicePixelRatio;
      if (upper !== null) u.ctx.fillRect(left, top, width, y(upper) - top);
      if (lower !== null) u.ctx.fillRect(left, y(lower), width, top + height - y(lower));
      for (const v of [lower, upper]) if (v !== null && y(v) > top && y(v) < top + height) {
        u.ctx.beginPath(); u.ctx.moveTo(left, y(v)); u.ctx.lineTo(left + width, y(v)); u.ctx.stroke();
      }
      u.ctx.restore();
    };
  }

  // What is drawn of a plot: as it is, as a part of its limit, or the first series less the second
  const isPercent = (p) => p.percent && p.limits[0] !== null && p.limits[1] !== null && p.limits[0] <= 0
    && p.limits[1] >= 0 && p.limits[1] > p.limits[0];
  const percent = (p, v) => 100 * v / (v < 0 ? -p.limits[0] || p.limits[1] : p.limits[1] || -p.limits[0]);
  const canSubtract = (p) => p.series.length === 2 && p.axis === "time" && !p.log && !p.band && p.marks === "lines";
  const isDifference = (p) => subtracting && canSubtract(p);
  const limitsOf = (p) => isDifference(p) ? [null, null] : isPercent(p)
    ? p.limits.map((v) => v && Math.sign(v) * 100) : p.limits;
  const unitOf = (p) => isPercent(p) ? "% of limit" : p.unit === "1" ? "" : p.unit;
  function valuesOf(p) {
    const seen = (v) => v === null ? null : p.log && !(v > 0) ? null : isPercent(p) ? percent(p, v) : v;
    const ys = p.series.map((s) => s.y.map(seen));
    return isDifference(p) ? [ys[0].map((v, i) => v === null || ys[1][i] === null ? null : v - ys[1][i])] : ys;
  }
  function linesOf(p) {  // name, colour, dashed
    if (isDifference(p)) return [{ ...p.series[0], name: p.series[0].name + " minus " + p.series[1].name, hue: 0, dashed: false }];
    const solid = p.series.filter((s) => !s.dashed).length;
    return p.series.map((s, i) => ({ ...s, hue: (p.band ? 0 : s.dashed ? i - solid : i) % HUES }));
  }

  // A comma-separated table: a name that a spreadsheet would take for a formula begins with a quote
  function cell(text) {
    const harmless = /^\s*[=+\-@|%]|^[\t\r\n]/.test(text) ? "'" + text : text;
    return '"' + harmless.replace(/"/g, '""') + '"';
  }
  function csv(shown) {  // of plots over the same x
    const head = [shown[0].axis === "time" ? "t [s]" : shown[0].axis];
    const columns = [shown[0].x];
    for (const p of shown) for (const s of p.series) {
      head.push(p.title + (p.series.length > 1 || s.name !== p.title ? ": " + s.name : "") + " [" + p.unit + "]");
      columns.push(s.y);
    }
    const rows = shown[0].x.map((_, i) => columns.map((c) => c[i] === null ? "" : String(c[i])).join(","));
    return [head.map(cell).join(","), ...rows].join("\r\n") + "\r\n";
  }
  function csvButton(name, shown) {
    const button = make("button", { type: "button", class: "csv", "aria-label": "download " + name + " as CSV" }, "CSV");
    button.addEventListener("click", () => save(name.replace(/[^\w.-]+/g, "_").slice(0, 60) + ".csv", csv(shown), "text/csv"));
    return button;
  }

  // One plot
  function key(line) {
    const swatch = make("i", { class: line.dashed ? "dashed" : "solid" });
    swatch.style.color = swatch.style.borderColor = `var(--s${line.hue})`;
    return swatch;
  }
  function tell(u, i) {  // the values at point i
    const lines = linesOf(u.plot);
    u.values.replaceChildren(...lines.map((line, k) => {
      const v = u.data[k + 1][i], raw = u.plot.series[k].y[i];
      const absolute = isPercent(u.plot) && !isDifference(u.plot) && v !== null && k === 0 ? ` (${shorten(raw)} ${u.plot.unit})` : "";
      const value = isPercent(u.plot) && v !== null ? Number(v.toPrecision(3)) + " %" : shorten(v);
      return make("span", {}, key(line), (u.named ? line.name + " " : "") + value + absolute);
    }));
  }
  function summary(plot) {
    const parts = linesOf(plot).map((line, k) => {
      const ys = valuesOf(plot)[k].filter((v) => v !== null);
      if (!ys.length) return line.name + " has no value";
      const least = ys.reduce((a, b) => Math.min(a, b)), most = ys.reduce((a, b) => Math.max(a, b));
      return `${line.name} from ${shorten(ys[0])} to ${shorten(ys[ys.length - 1])}, lowest ${shorten(least)}, highest ${shorten(most)}`;
    });
    return `${plot.title}${unitOf(plot) && " in " + unitOf(plot)}: ${parts.join("; ")}`;
  }
  function remarks(plot) {
    const found = plot.note ? [plot.note] : [], all = valuesOf(plot).flat().filter((v) => v !== null);
    if (all.length) {
      const near = nearLimits(plot, all.reduce((a, b) => Math.min(a, b)), all.reduce((a, b) => Math.max(a, b)));
      const limits = limitsOf(plot), far = limits.some((v, i) => v !== null && near[i] === null);
      const told = limits[0] === null ? "≤ " + shorten(limits[1]) : limits[1] === null ? "≥ " + shorten(limits[0])
        : shorten(limits[0]) + " to " + shorten(limits[1]);
      if (far && !plot.log && !plot.note && !isPercent(plot)) found.push(`limits ${told} ${unitOf(plot)}`.trim());
    }
    if (plot.x.length < plot.points)
      found.push(`${plot.x.length} of ${plot.points} points: the lowest and highest of each stretch`);
    return found;
  }
  function commonEnd(plots) {  // "_joint_q", where most of many titles end as the last one does
    const ends = plots.map((p) => (/(_[A-Za-z]{1,12}){1,3}$/.exec(p.title) || [""])[0].split("_").slice(1));
    const final = ends[ends.length - 1];
    const share = (n) => ends.filter((words) => words.slice(-n).join("_") === final.slice(-n).join("_")).length / plots.length;
    let count = plots.length > 4 ? final.length : 0;
    while (count && share(count) < 0.6) count--;
    return count ? "_" + final.slice(-count).join("_") : "";
  }
  function draw(plot, place, { named, height, end }) {
    const title = make("h4", { title: plot.title }, end && plot.title.endsWith(end) && plot.title !== end ? plot.title.slice(0, -end.length) : plot.title), values = make("p", { class: "values" });
    const box = make("div", { class: "plot", role: "group", "aria-label": summary(plot) },
      make("div", { class: "head" }, title, csvButton(plot.title, [plot])), values);
    place.append(box);
    const axis = { stroke: () => colour("soft"), grid: { stroke: () => colour("line"), width: 1 },
      ticks: { stroke: () => colour("line"), width: 1, size: 4 }, font: "11px system-ui, sans-serif", gap: 3 };
    const units = (u, ticks) => marked(ticks).map((v, i) => v + (i === ticks.length - 1 && plot.axis === "time" ? " s" : ""));
    const lines = linesOf(plot), unit = unitOf(plot);
    const aside = (u, low, high) => [low - 0.04 * (high - low || 1), high + 0.04 * (high - low || 1)];
    const options = {
      width: Math.max(box.clientWidth, 120), height,
      cursor: { y: false, drag: { x: false, y: false }, points: { size: 6 } },
      scales: { x: { time: false, distr: plot.levels ? 3 : 1, range: plot.levels ? levels(plot.x) : plot.marks === "lines" ? undefined : aside }, y: { range: range(plot), distr: plot.log ? 3 : 1 } },
      legend: { show: false },
      bands: plot.band ? [{ series: [lines.length, lines.length - 1], fill: () => colour("s0") + "33" }] : [],
      axes: [{ ...axis, size: plot.axis === "time" ? 22 : 36, space: height < 150 ? 36 : 44, values: units,
        ...(plot.axis === "time" ? {} : { label: plot.axis, labelSize: 14, labelGap: 0, labelFont: "11px system-ui, sans-serif" }),
        ...(plot.levels ? { splits: () => plot.x, filter: (u, all) => all, values: (u, all) => all.map(shorten) } : {}) },
      { ...axis, size: room, space: 24, ...(unit ? { label: unit, labelSize: 14, labelGap: 0, labelFont: "11px system-ui, sans-serif" } : {}),
        values: (u, ticks) => plot.log ? ticks.map((v) => v === null ? "" : shorten(v)) : marked(ticks),
        ...(plot.log ? { splits: (u, i, low, high) => powers(low, high), filter: (u, ticks) => ticks } : {}) }],
      series: [{}].concat(lines.map((s) => ({ stroke: () => colour("s" + s.hue), width: 1.8,
        dash: s.dashed ? [6, 4] : [], paths: plot.marks === "points" ? () => null
          : s.held ? uPlot.paths.stepped({ align: 1 }) : undefined,
        points: { show: plot.marks === "lines" ? plot.x.length < 3 : !(plot.band && s.dashed), size: 6 } }))),
      hooks: { drawClear: [drawLimits(plot)], setCursor: [(u) => follow(u)] },
    };
    const u = new uPlot(options, [plot.x, ...valuesOf(plot)], box);
    Object.assign(u, { plot, values, named, box });
    u.root.setAttribute("aria-hidden", "true");  // its numbers are in the label and the values
    for (const remark of remarks(plot)) box.append(make("p", { class: "note" }, remark));
    new ResizeObserver(() => { if (box.clientWidth && box.clientWidth !== u.width)
      u.setSize({ width: box.clientWidth, height }); }).observe(box);
    drawn.push(u);
    tell(u, plot.axis === "time" ? nearest(plot.x, time) : plot.x.length - 1);
    if (plot.axis === "time") u.setCursor({ left: u.valToPos(time, "x"), top: -10 }, false);
  }
  function follow(u) {
    if (!u.plot) return;
    const inside = u.cursor.left >= 0 && u.cursor.event;
    if (u.plot.axis !== "time") { if (inside && u.cursor.idx !== null) tell(u, u.cursor.idx); }
    else if (inside) { setPlaying(false); setTime(u.posToVal(u.cursor.left, "x"), u); }
    else if (u.cursor.left < 0) setTimeout(() => setTime(time), 0);  // the mouse has left: back to the time
  }

  // The plots of one place: a group at a time where there are many, each group with one legend
  const FEW = 16;  // plots of a place, which are shown all at once
  function legendOf(plots) {  // the lines that the plots have in common; null where each has its own
    const found = new Map();
    for (const p of plots) for (const line of linesOf(p)) {
      const known = found.get(line.name);
      if (known && (known.hue !== line.hue || known.dashed !== line.dashed)) return null;
      found.set(line.name, { ...line, count: (known ? known.count : 0) + 1 });
    }
    return [...found.values()].some((line) => 2 * line.count < plots.length) || plots.length < 2 ? null : [...found.values()];
  }
  function fill(panel, name, plots) {  // draw a group, again where it was
    for (let i = drawn.length; i--;) if (panel.contains(drawn[i].root)) drawn.splice(i, 1)[0].destroy();
    panel.replaceChildren();
    const legend = legendOf(plots), told = make("p", { class: "legend" });
    for (const line of legend || []) told.append(make("span", {}, key(line), line.name));
    if (plots.some((p) => limitsOf(p).some((v) => v !== null)))
      told.append(make("span", {}, make("i", { class: "limit" }), "limit"));
    if (plots.length > 1 && plots.every((p) => p.x === plots[0].x)) told.append(csvButton(name || "plots", plots));
    if (name) panel.append(make("h3", {}, name));
    panel.append(told);
    const grid = make("div", { class: plots.length > 4 ? "grid small" : "grid" });
    panel.append(grid);
    panel.dataset.drawn = "yes";
    const end = commonEnd(plots);
    for (const plot of plots) draw(plot, grid, { named: !legend, height: plots.length > 4 ? 138 : 180, end });
  }
  function lay(place, plots) {
    const names = [...new Set(plots.map((p) => p.group))];
    const panels = names.map((name) => make("div", { class: "panel", hidden: "" }));
    const of = (name) => plots.filter((p) => p.group === name);
    const show = (chosen) => panels.forEach((panel, i) => {
      panel.hidden = chosen !== null && names[i] !== chosen;
      if (!panel.hidden && !panel.dataset.drawn) fill(panel, names[i], of(names[i]));
    });
    const bar = make("div", { class: "chooser" });
    place.append(bar, ...panels);
    const choices = make("div", { class: "choices", role: "group", "aria-label": "which plots" });
    const choose = (button, name) => {
      for (const other of choices.children) other.setAttribute("aria-pressed", String(other === button));
      show(name); setTime(time); sift();
    };
    const many = plots.length > FEW && names.length > 1;
    if (many) for (const name of [...names, null]) {
      const count = name === null ? plots.length : of(name).length;
      const button = make("button", { type: "button", "aria-pressed": "false" }, `${name === null ? "All" : name} `, make("small", {}, String(count)));
      button.addEventListener("click", () => choose(button, name));
      choices.append(button);
    }
    if (many) bar.append(choices);
    const words = make("input", { type: "search", placeholder: "only names with …", "aria-label": "only plots whose name has" });
    const sift = () => {
      const word = words.value.trim().toLowerCase();
      for (const u of drawn) if (place.contains(u.root)) u.box.hidden = !u.plot.title.toLowerCase().includes(word);
    };
    words.addEventListener("input", () => { sift(); setTime(time); });
    if (names.some((name) => of(name).length > FEW)) bar.append(words);
    if (plots.some(canSubtract)) {
      const pairs = [...new Set(plots.filter(canSubtract).map((p) => `${p.series[0].name} minus ${p.series[1].name}`))];
      const less = make("button", { type: "button", "aria-pressed": "false" }, "show " + (pairs.length === 1 ? pairs[0] : "the difference"));
      less.addEventListener("click", () => {
        subtracting = !subtracting;
        less.setAttribute("aria-pressed", String(subtracting));
        panels.forEach((panel, i) => { if (panel.dataset.drawn) fill(panel, names[i], of(names[i])); });
        sift(); setTime(time);
      });
      bar.append(less);
    }
    if (many) choose(choices.firstElementChild, names[0]); else show(null);
  }

  // Certificates, one at a time: a square for each entry
  const SIGNS = ["", "?", "~", "×", "!"], FINE = 400;  // so many squares are drawn one by one, and so many signs
  const svg = (name, attributes, text) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const attribute in attributes) node.setAttribute(attribute, attributes[attribute]);
    if (text !== undefined) node.textContent = text;
    return node;
  };
  function map(c, number) {
    const m = c.rows.length, n = c.columns.length, at = new Map(c.told.map((k, i) => [k, i]));
    const title = make("h3", {}, number + ": " + c.subject + " – " + c.verdict.replace("_", " ")), told = make("p", { role: "status" });
    const picture = svg("svg", { viewBox: `0 0 ${n} ${m}`, role: "img", tabindex: "0", preserveAspectRatio: "xMinYMin", "aria-label": title.textContent + "; the arrow keys move over its entries" });
    const mark = svg("rect", { width: 1, height: 1, class: "here", visibility: "hidden" });
    let here = -1;
    const say = (k) => {
      here = k;
      const i = Math.floor(k / n), j = k % n, e = at.get(k);
      mark.setAttribute("x", j); mark.setAttribute("y", i); mark.setAttribute("visibility", "visible");
      const numbers = e === undefined ? `its numbers are not in this page, which has those of the ${c.told.length} entries nearest to failing` :
        `derivative ${c.derivative[e]}, differences ${c.difference[e]}, tolerance ${shorten(c.tolerance[e])}, would have noticed ${shorten(c.noticeable[e])}`;
      told.textContent = `d ${c.rows[i]} / d ${c.columns[j]}: ${numbers}: ${data.verdicts[c.codes[k]].replace("_", " ")}`;
    };
    let signs = 0;
    for (let y = 0; y < m; y++) for (let x = 0; x < n;) {
      const code = c.codes[y * n + x];
      let end = x + 1;
      while (m * n > FINE && end < n && c.codes[y * n + end] === code) end++;
      picture.append(svg("rect", { x, y, width: end - x, height: 1, fill: `var(--v${code})`, class: m * n > FINE ? "run" : "" }));
      if (code !== "0") for (let k = x; k < end && signs < FINE; k++, signs++)
        picture.append(svg("text", { x: k + 0.5, y: y + 0.5, class: "sign", "pointer-events": "none" }, SIGNS[code]));
      x = end;
    }
    picture.append(mark);
    picture.addEventListener("pointermove", (event) => {
      const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(picture.getScreenCTM().inverse());
      const j = Math.floor(point.x), i = Math.floor(point.y);
      if (i >= 0 && i < m && j >= 0 && j < n) say(i * n + j);
    });
    picture.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: n, ArrowUp: -n }[event.key];
      if (!step) return;
      event.preventDefault();
      say(here < 0 ? 0 : Math.min(Math.max(here + step, 0), m * n - 1));
    });
    told.textContent = `${m} rows: ${c.rows.join(", ")}. ${n} columns: ${c.columns.join(", ")}.`;
    picture.style.maxWidth = 28 * n + "px";
    return make("div", { class: "map" }, title, picture, told);
  }
  function drawMaps() {
    const maps = byId("maps"), all = data.certificates;
    if (!maps || !all.length) return;
    const legend = make("p", { class: "legend" });
    data.verdicts.forEach((name, i) => {
      const square = make("i", { class: "square" });
      square.style.background = `var(--v${i})`;
      legend.append(make("span", {}, square, (SIGNS[i] + " " + name.replace("_", " ")).trim()));
    });
    const first = Math.max(0, all.findIndex((c) => c.verdict !== "agree"));
    const select = make("select", { "aria-label": "certificate that is drawn" },
      ...all.map((c, i) => make("option", { value: i }, `${i}: ${c.subject} – ${c.verdict.replace("_", " ")}`)));
    select.value = first;
    const place = make("div", {});
    const show = () => place.replaceChildren(map(all[select.value], select.value));
    select.addEventListener("change", show);
    maps.append(...(all.length > 1 ? [select] : []), legend, place);
    show();
  }

  // The page around them
  function listSections() {
    const contents = byId("contents");
    [...document.querySelectorAll("section h2")].forEach((title, i) => {
      title.id = title.id || "part" + i;
      const link = make("a", { href: "#" + title.id }, title.textContent), folded = title.closest("details");
      if (folded) link.addEventListener("click", () => { folded.open = true; });
      contents.append(link);
    });
  }
  function reachTables() {  // by the keyboard, where they scroll
    for (const box of document.querySelectorAll(".wide"))
      if (box.scrollHeight > box.clientHeight || box.scrollWidth > box.clientWidth) box.tabIndex = 0; else box.removeAttribute("tabindex");
  }

  for (const place of document.querySelectorAll(".plots")) {
    const plots = data.plots.filter((p) => p.place === place.id), folded = place.closest("details:not([open])");
    const fillPlace = () => { if (plots.length) lay(place, plots); };
    if (folded) folded.addEventListener("toggle", fillPlace, { once: true }); else fillPlace();  // drawn when they are seen
  }
  drawMaps();
  listSections();
  reachTables();
  addEventListener("resize", reachTables);
  document.addEventListener("toggle", reachTables, true);
  if (slider) {
    slider.addEventListener("input", () => { setPlaying(false); setTime(Number(slider.value)); });
    play.addEventListener("click", () => setPlaying(!playing));
    const byFrame = (event) => {  // a hundredth of the motion
      const step = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      setPlaying(false);
      setTime(time + step * data.duration / 100);
    };
    slider.addEventListener("keydown", byFrame);
    document.addEventListener("keydown", (event) => {  // where no other control takes the space bar
      if (event.key !== " " || event.target.closest("button, select, input, summary, a, [tabindex]")) return;
      event.preventDefault();
      setPlaying(!playing);
    });
    byId("fold").addEventListener("click", () => {
      const folded = byId("motion").classList.toggle("folded");
      byId("fold").textContent = folded ? "show" : "hide";
      byId("fold").setAttribute("aria-expanded", String(!folded));
    });
    setTime(0);
  }
  byId("download").addEventListener("click", () => save("record.json", byId("record").textContent, "application/json"));
  if (!frame) document.documentElement.dataset.ready = "yes";  // a page without a motion
  else whenReady(() => {
    const v = viewer();
    v.gui.domElement.style.display = "none";  // the slider is the page's own
    v.animator.play();
    v.animator.pause();
    setTime(time);
    document.documentElement.dataset.ready = "yes";
  });
  const redraw = () => drawn.forEach((u) => u.redraw(false, true));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  addEventListener("beforeprint", () => {
    for (const part of document.querySelectorAll("details.part")) part.open = true;
    document.documentElement.classList.add("printed");
    redraw();
    if (!isReady()) return;
    viewer().render();
    byId("still").src = viewer().renderer.domElement.toDataURL("image/png");
  });
  addEventListener("afterprint", () => { document.documentElement.classList.remove("printed"); redraw(); });
})();

// Learning curves of one quantity, and a table that reads them at one step.
const curves = {
  domain: domains[0], quantity: "evaluation/success", line: "mean", seeds: true, hidden: new Set(), step: null,
  plot: null, last: 1,
};
// Success lies between 0 and 1: the same axis in every domain, as in the figures.
const LIMITS = {"evaluation/success": [-0.03, 1.05]};

function quantityName(name) {
  const [group, rest] = name.includes("/") ? name.split(/\/(.*)/) : ["other", name];
  return group === "evaluation" ? heading(rest) : `${group}: ${heading(rest)}`;
}

function curvesShown() {
  return DATA.runs
    .map((run, index) => ({run, index, curve: run.curves[curves.quantity]}))
    .filter(({run, curve}) => run.domain === curves.domain && curve);
}

// A seed has steps of its own only where they are not those of all.
const stepsOf = (curve, seed) => seed.steps ?? curve.steps;

function drawCurves() {
  const shown = curvesShown();
  const visible = shown.filter(({index}) => !curves.hidden.has(index));
  const last = Math.max(1, ...shown.flatMap(({curve}) => curve.seeds.map((seed) => stepsOf(curve, seed).at(-1))));
  const faint = visible.length > 3 ? "faint" : "";
  const best = optimumShown(shown);
  const values = visible.flatMap(({curve}) => [
    ...(curve.mean ?? []).flatMap((mean, i) => curves.line === "mean"
      ? [mean - curve.std[i], mean + curve.std[i]] : [curve.iqm[i]]),
    ...(curves.seeds ? curve.seeds.flatMap((seed) => seed.values) : []),
  ]);
  if (best !== null) values.push(best);
  const height = window.innerWidth < 760 ? 260 : 360;
  const plot = new Plot(byId("curve"), {
    height, x: [0, last], y: span(values, LIMITS[curves.quantity]), label: "environment steps"});
  curves.plot = plot;
  if (best !== null) {
    add(plot.svg, "line", {class: "best", x1: plot.left, x2: plot.right, y1: plot.y(best), y2: plot.y(best)});
  }
  for (const {run, curve} of visible) {
    const several = curve.seeds.length > 1;
    if (curves.seeds && several) {
      for (const seed of curve.seeds) {
        plot.line(stepsOf(curve, seed), seed.values, {class: `seed ${faint}`, colour: run.colour});
      }
    }
    if (!curve.mean) continue;
    if (curves.line === "mean" && several) {
      plot.band(curve.steps, curve.mean.map((mean, i) => mean - curve.std[i]),
                curve.mean.map((mean, i) => mean + curve.std[i]), {colour: run.colour});
    }
    plot.line(curve.steps, curves.line === "mean" ? curve.mean : curve.iqm, {colour: run.colour});
  }
  if (best !== null) {
    const under = plot.y(best) < plot.top + 16;
    const place = {x: plot.right - 8, y: plot.y(best) + (under ? 15 : -5), "text-anchor": "end"};
    add(plot.svg, "text", {class: "optimum", ...place}, `optimum ${readable(best)}`);
  }
  plot.marks = add(plot.svg, "g");
  curves.last = last;
  readCurves(curves.step === null ? last : Math.min(curves.step, last));
}

function optimumShown(shown) {
  const name = curves.quantity.startsWith("evaluation/") ? curves.quantity.slice(11) : "";
  return shown.map(({run}) => run.optimum[name]).find((value) => value !== undefined && value !== null) ?? null;
}

// Put the cursor on a step: marks in the plot, numbers in the table. `close`: the seed's point nearest to the pointer.
function readCurves(step, close = null) {
  const plot = curves.plot;
  const shown = curvesShown();
  curves.step = step === curves.last ? null : step;
  plot.marks.replaceChildren();
  add(plot.marks, "line", {class: "cursor", x1: plot.x(step), x2: plot.x(step), y1: plot.top, y2: plot.bottom});
  const rows = [];
  for (const {run, index, curve} of shown) {
    const off = curves.hidden.has(index);
    const within = curve.steps.length && step <= curve.steps.at(-1) && step >= curve.steps[0];
    const place = within ? nearest(curve.steps, step) : null;
    const seeds = curve.seeds.map((one) => {
      const own = stepsOf(curve, one);
      return {seed: one.seed, value: step <= own.at(-1) ? one.values[nearest(own, step)] : null};
    });
    rows.push({run, index, off, seeds, several: seeds.length > 1,
               mean: place === null ? null : curve.mean[place], std: place === null ? null : curve.std[place],
               iqm: place === null ? null : curve.iqm[place]});
    if (!off && place !== null) {
      const value = curves.line === "mean" ? curve.mean[place] : curve.iqm[place];
      add(plot.marks, "circle", {
        class: "point", colour: run.colour, r: 4, cx: plot.x(curve.steps[place]), cy: plot.y(value)});
    }
  }
  if (close) {
    const x = plot.x(close.step);
    add(plot.marks, "circle", {class: "point", colour: close.run.colour, r: 5, cx: x, cy: plot.y(close.value)});
    const right = x > (plot.left + plot.right) / 2;
    add(plot.marks, "text", {
      class: "tag", x: x + (right ? -10 : 10), y: Math.max(plot.y(close.value) - 9, 12),
      "text-anchor": right ? "end" : "start",
    }, `${close.run.label}, seed ${close.seed}: ${readable(close.value)} at ${readable(close.step, true)}`);
  }
  const spoken = rows.filter((row) => !row.off).map((row) => `${row.run.label} ${decimal(row.mean)}`).join(", ");
  const svg = plot.svg;
  svg.setAttribute("aria-valuemin", 0);
  svg.setAttribute("aria-valuemax", curves.last);
  svg.setAttribute("aria-valuenow", step);
  svg.setAttribute("aria-valuetext", `step ${readable(step, true)}, ${quantityName(curves.quantity)}: ${spoken}`);
  fillReading(step, rows);
}

function fillReading(step, rows) {
  const box = byId("reading");
  const focused = box.contains(document.activeElement) ? document.activeElement.dataset.index : null;
  box.replaceChildren();
  byId("reading-title").textContent =
    `${quantityName(curves.quantity)} at step ${readable(step, true)}; the boxes show and hide runs`;
  const table = add(box, "table");
  const head = add(add(table, "thead"), "tr");
  const columns = [["run", ""], ["mean ± std", "number"], ["interquartile mean", "number"], ["each seed", ""]];
  for (const [name, kind] of columns) {
    add(head, "th", {scope: "col", class: kind}, name);
  }
  const body = add(table, "tbody");
  for (const {run, index, off, mean, std, iqm, seeds, several} of rows) {
    const line = add(body, "tr", {class: off ? "off" : ""});
    const label = add(add(line, "td"), "label");
    const tick = add(label, "input", {type: "checkbox", "data-index": index, checked: !off});
    tick.addEventListener("change", () => {
      tick.checked ? curves.hidden.delete(index) : curves.hidden.add(index);
      drawCurves();
    });
    if (focused === String(index)) tick.focus();
    label.append(" ");
    add(add(label, "span", {colour: run.colour}), "span", {class: "swatch"});
    label.append(run.label);
    add(line, "td", {class: "number"}, mean === null ? "–" : readable(mean) + (several ? ` ± ${readable(std)}` : ""));
    add(line, "td", {class: "number"}, iqm === null ? "–" : readable(iqm));
    const each = add(line, "td");
    for (const {seed, value} of seeds) {
      const one = add(each, "span", {class: "each"});
      add(one, "span", {class: "dim"}, `${seed}: `);
      one.append(value === null ? "–" : readable(value));
    }
  }
}

function closestPoint(event) {
  const plot = curves.plot;
  const step = plot.under(event);
  const high = plot.heightUnder(event);
  let best = null;
  for (const {run, index, curve} of curvesShown()) {
    if (curves.hidden.has(index)) continue;
    for (const one of curve.seeds) {
      const own = stepsOf(curve, one);
      const place = nearest(own, step);
      const far = Math.hypot(plot.x(own[place]) - plot.x(step), plot.y(one.values[place]) - high);
      if (!best || far < best.far) best = {far, run, seed: one.seed, step: own[place], value: one.values[place]};
    }
  }
  return best;
}

function allSteps() {
  return [...new Set(curvesShown().flatMap(({curve}) =>
    curve.seeds.flatMap((seed) => stepsOf(curve, seed))))].sort((a, b) => a - b);
}

function fillQuantities() {
  const here = DATA.runs.filter((run) => run.domain === curves.domain);
  const names = [...new Set(here.flatMap((run) => Object.keys(run.curves)))];
  if (!names.includes(curves.quantity)) curves.quantity = names[0];
  select(byId("quantity"), names.map((name) => {
    const [group, rest] = name.includes("/") ? name.split(/\/(.*)/) : ["other", name];
    return [name, heading(rest), group];
  }), curves.quantity);
}

(function startCurves() {
  const any = DATA.runs.some((run) => Object.keys(run.curves).length);
  if (!any) {
    byId("curve").remove();
    byId("reading").replaceWith(Object.assign(document.createElement("p"), {
      className: "missing", textContent: "No metrics were kept with these runs."}));
    byId("curves").querySelector(".controls").hidden = true;
    return;
  }
  byId("domain-label").hidden = domains.length < 2;
  select(byId("domain"), domains.map((domain) => [domain, DATA.names[domain]]));
  fillQuantities();
  const redraw = () => { curves.step = null; drawCurves(); };
  byId("domain").addEventListener("change", (event) => {
    curves.domain = event.target.value;
    fillQuantities();
    redraw();
  });
  byId("quantity").addEventListener("change", (event) => { curves.quantity = event.target.value; redraw(); });
  byId("each-seed").addEventListener("change", (event) => { curves.seeds = event.target.checked; drawCurves(); });
  for (const choice of document.querySelectorAll("input[name=line]")) {
    choice.addEventListener("change", () => { curves.line = choice.value; drawCurves(); });
  }
  const svg = byId("curve");
  const follow = (event) => {
    const close = closestPoint(event);
    if (close) readCurves(close.step, close);
  };
  svg.addEventListener("pointermove", follow);
  svg.addEventListener("pointerdown", follow);
  svg.addEventListener("keydown", (event) => {
    const steps = allSteps();
    const place = nearest(steps, curves.step ?? curves.last);
    const to = {ArrowLeft: place - 1, ArrowRight: place + 1, ArrowDown: place - 1, ArrowUp: place + 1,
                PageDown: place - 10, PageUp: place + 10, Home: 0, End: steps.length - 1}[event.key];
    if (to === undefined) return;
    event.preventDefault();
    readCurves(steps[Math.min(Math.max(to, 0), steps.length - 1)]);
  });
  onResize(svg, drawCurves);
})();

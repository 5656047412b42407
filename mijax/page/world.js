// The three panels of a moment: what the agent sees, what is true, what it remembers.
const KINDS = {"#": "wall", "?": "info", G: "goal", x: "hell", o: "other", ".": ""};
const MEANINGS = {G: "green: goal", x: "red: hell", "?": "blue: information", o: "sand: another end",
                  "#": "grey: wall"};
const STEPS = {right: [1, 0], up: [0, -1], left: [-1, 0], down: [0, 1]};

function drawGrid(box, label, kinds) {
  // kinds: a string per row. Returns the drawing, in cells.
  const svg = add(box, "svg", {class: "world", role: "img", "aria-label": label,
                               viewBox: `-0.02 -0.02 ${kinds[0].length + 0.04} ${kinds.length + 0.04}`});
  kinds.forEach((row, y) => [...row].forEach((kind, x) => {
    add(svg, "rect", {class: `cell ${KINDS[kind]}`, x, y, width: 1, height: 1});
  }));
  return svg;
}

function panel(title) {
  const box = add(byId("panels"), "div", {class: "panel"});
  add(box, "h3", {}, title);
  return box;
}

function drawPanels(shown, episode, step) {
  byId("panels").replaceChildren();
  const grid = episode.grid;
  const [seen, truth, memory] = ["What the agent sees", "What is true", "What it remembers"].map(panel);
  if (grid) drawGridPanels(shown, episode, step, seen, truth);
  else {
    drawView(seen, episode.seen, step, "seen");
    if (shown.about) add(seen, "p", {}, shown.about);
    drawView(truth, episode.true, step, "true");
  }
  if (shown.variables.length) {
    const list = add(truth, "dl");
    shown.variables.forEach(({name, hidden}, i) => {
      add(list, "dt", {}, `${heading(name)}${hidden ? " (hidden)" : ""}`);
      add(list, "dd", {}, shortest(episode.truth[step][i]));
    });
  }
  drawMemory(shown, episode, step, memory);
}

function drawGridPanels(shown, episode, step, seen, truth) {
  const {kinds, cells, goal, told} = episode.grid;
  const width = kinds[0].length;
  const centre = (cell) => [cell % width + 0.5, Math.floor(cell / width) + 0.5];
  const at = (place) => `row ${Math.floor(place / width)}, column ${place % width}`;
  const bare = kinds.map((row, y) => [...row].map((_, x) => told[step] && y * width + x === goal ? "G" : ".").join(""));
  const news = told[step] ? `the goal is at ${at(goal)}` : "the goal is not shown";
  const left = drawGrid(seen, `The agent at ${at(cells[step])}; ${news}`, bare);
  add(seen, "p", {}, `Its place${kinds.join("").includes("#") ? ", and nothing of the walls" : ""}; ${news}.`);
  const right = drawGrid(truth, `The agent at ${at(cells[step])}, the goal at ${at(goal)}`, kinds);
  const there = new Set(kinds.join(""));
  add(truth, "p", {}, Object.entries(MEANINGS).filter(([kind]) => there.has(kind)).map(([, text]) => text).join(", "));
  const way = cells.slice(0, step + 1).map((cell) => centre(cell).join(","));
  add(right, "polyline", {class: "way", points: way.join(" ")});
  for (const svg of [left, right]) {
    const [cx, cy] = centre(cells[step]);
    add(svg, "circle", {class: "agent", cx, cy, r: 0.27});
  }
  const next = step < cells.length - 1 && shown.discrete ? STEPS[shown.actions[episode.action[step]]] : null;
  if (next) {
    const [x, y] = centre(cells[step]);
    const [dx, dy] = next;
    const tip = [x + 0.62 * dx, y + 0.62 * dy];
    add(right, "path", {class: "arrow", d: `M${x + 0.3 * dx} ${y + 0.3 * dy}L${tip.join(" ")}`
      + `M${tip[0] - 0.16 * dx - 0.13 * dy} ${tip[1] - 0.16 * dy - 0.13 * dx}L${tip.join(" ")}`
      + `L${tip[0] - 0.16 * dx + 0.13 * dy} ${tip[1] - 0.16 * dy + 0.13 * dx}`});
  }
}

function drawView(box, view, step, name) {
  if (view.images) {
    const row = add(box, "div", {class: "pictures"});
    view.images.forEach((frames, channel) => {
      const figure = add(row, "figure");
      const alt = `channel ${channel}, ${name}, step ${step}`;
      add(figure, "img", {src: `data:image/png;base64,${frames[step]}`, alt});
      add(figure, "figcaption", {}, `channel ${channel}`);
    });
  } else {
    const list = add(box, "dl");
    view.numbers[step].forEach((value, i) => {
      add(list, "dt", {}, String(i));
      add(list, "dd", {}, decimal(value));
    });
  }
}

function gauge(box, label, value, colour) {
  const line = add(box, "div", {class: "gauge"});
  add(line, "span", {}, `${label}: ${decimal(value)}`);
  const track = add(line, "div", {class: "track", "aria-hidden": "true"});
  const fill = add(track, "div", {class: "fill", colour});
  fill.style.width = `${100 * Math.min(Math.max(value, 0), 1)}%`;
}

function drawMemory(shown, episode, step, box) {
  const weights = attentionOf(episode)?.[step] ?? null;
  if (weights && episode.grid) {
    const {kinds, cells} = episode.grid;
    const width = kinds[0].length;
    const svg = drawGrid(box, "Where on its way the transformer looks", kinds.map((row) => row.replace(/[^#]/g, ".")));
    const onCell = new Map();
    weights.forEach((weight, t) => onCell.set(cells[t], (onCell.get(cells[t]) ?? 0) + weight));
    for (const [cell, weight] of onCell) {
      if (weight < 0.01) continue;
      add(svg, "circle", {class: "looked", cx: cell % width + 0.5, cy: Math.floor(cell / width) + 0.5,
                          r: 0.45 * Math.sqrt(Math.min(weight, 1))});
    }
  }
  if (weights) {
    const most = weights.map((weight, t) => [weight, t]).sort((a, b) => b[0] - a[0]).slice(0, 3);
    add(box, "p", {}, `Attends to ${most.filter(([weight]) => weight >= 0.01)
      .map(([weight, t]) => `step ${t} (${weight.toFixed(2)})`).join(", ")}.`);
  }
  const colour = DATA.palette[0];
  for (const [text, values] of [["f", episode.explained], ["its memory branch", episode.explained_by_agent]]) {
    if (values) gauge(box, `Of z_s, ${text} explains`, values[step], colour);
  }
  if (!episode.explained && !episode.explained_by_agent) {
    add(box, "p", {}, "This agent does not predict z_s: there is nothing to explain.");
  }
  if (!weights) add(box, "p", {}, "Without a transformer there is no attention to show.");
}

// Step through an episode: the panels of one moment, and over all steps rewards, what is explained, values, attention.
const player = {run: 0, episode: 0, head: -1, step: 0, strips: [], timer: null};
const PLAY = "M3 1L14 8L3 15Z";
const PAUSE = "M4 2V14M12 2V14";
const chosenRun = () => DATA.runs[player.run].episodes;
const chosenEpisode = () => chosenRun().episodes[player.episode];

function attentionOf(episode) {
  // Of each step, its weights on the steps up to itself: of one head, or the mean of all.
  const heads = episode.attention;
  if (!heads) return null;
  if (player.head >= 0 && player.head < heads.length) return heads[player.head];
  return heads[0].map((row, t) => row.map((_, i) => heads.reduce((sum, head) => sum + head[t][i], 0) / heads.length));
}

function strip(title, lines, options = {}) {
  // lines: {name, values, colour, kind?, action?}; options: ring, best, floor, taken, heat
  return {title, lines, ...options};
}

function stripsOf(shown, episode) {
  const [ours, base] = DATA.palette;
  const strips = [];
  const rewards = [{name: "reward of the task", values: episode.reward, colour: base}];
  if (episode.bonus) {
    rewards.unshift({name: `intrinsic (weight ${shown.weight})`, colour: ours,
                     values: episode.bonus.map((value) => value === null ? null : shown.weight * value)});
  }
  strips.push(strip("Reward on arriving", rewards, {ring: episode.bonus ? peakOf(episode.bonus) : null}));
  if (episode.explained || episode.explained_by_agent) {
    strips.push(strip("Fraction of z_s explained by the history", [
      {name: "f, which pays the bonus", values: episode.explained, colour: ours},
      {name: "the memory branch", values: episode.explained_by_agent, colour: ours, kind: "dashed"},
    ].filter((line) => line.values), {best: 1, floor: -1}));
  }
  const last = episode.reward.length - 1;
  const until = (values) => values.map((value, t) => t < last ? value : null);  // nothing is done at the end
  if (shown.discrete) {
    strips.push(strip("Q(h, a); dot: taken", shown.actions.map((name, a) => ({
      name, colour: DATA.palette[a % DATA.palette.length], values: until(episode.q.map((row) => row[a])), action: a,
    })), {taken: true}));
  } else {
    strips.push(strip("Q(h, a) of the action taken", [
      {name: "Q", colour: ours, values: until(episode.q.map((row) => row[0]))}]));
    strips.push(strip("Actions", shown.actions.map((name, a) => ({
      name, colour: DATA.palette[a % DATA.palette.length], values: until(episode.action.map((row) => row[a])),
    }))));
  }
  if (episode.attention) {
    strips.push(strip("Attention of each step (across) to those before it (up)", [], {heat: true}));
  }
  return strips;
}

function peakOf(values) {
  return values.reduce((best, value, t) => value !== null && value > (values[best] ?? -Infinity) ? t : best, 0);
}

function drawSeries() {
  const shown = chosenRun();
  const episode = chosenEpisode();
  const box = byId("series");
  const last = episode.reward.length - 1;
  box.replaceChildren();
  player.strips = stripsOf(shown, episode).map((one) => {
    const frame = add(box, "div", {class: "strip"});
    add(frame, "h3", {}, one.title);
    const keys = add(frame, "div", {class: "keys"});
    const svg = add(frame, "svg", {class: "plot", role: "img", "aria-label": one.title});
    const values = one.lines.flatMap((line) => line.values).concat(one.best ?? []);
    const kept = one.floor === undefined ? values : values.filter((value) => value === null || value > one.floor);
    const across = [-0.5, last + 0.5];
    const plot = new Plot(svg, {
      height: one.heat ? 180 : 140, x: across, y: one.heat ? across : span(kept), wholeTicks: true,
      wholeHeights: one.heat, left: 46});
    episode.reveals.forEach((told, t) => {
      if (told) {
        const left = plot.x(t - 0.5);
        add(plot.inside, "rect", {
          class: "told", x: left, width: plot.x(t + 0.5) - left, y: plot.top, height: plot.bottom - plot.top});
      }
    });
    if (one.heat) drawHeat(plot, attentionOf(episode));
    if (one.best !== undefined) {
      add(svg, "line", {class: "best", x1: plot.left, x2: plot.right, y1: plot.y(one.best), y2: plot.y(one.best)});
    }
    for (const line of one.lines) {
      const clipped = line.values.map((value) => value === null ? null : Math.max(value, plot.ys[0]));
      plot.line(clipped.map((_, t) => t), clipped, {colour: line.colour, class: line.kind ?? ""});
    }
    if (one.taken) {
      episode.action.slice(0, -1).forEach((a, t) => {
        add(svg, "circle", {class: "point", colour: one.lines[a].colour, r: 3.2, cx: plot.x(t),
                            cy: plot.y(episode.q[t][a])});
      });
    }
    if (one.ring !== null && one.ring !== undefined) {
      add(svg, "circle", {class: "ring", r: 8, cx: plot.x(one.ring), cy: plot.y(one.lines[0].values[one.ring] ?? 0)});
    }
    const cursor = plot.upright(player.step, {class: "cursor"});
    svg.addEventListener("pointerdown", (event) => { goTo(plot.under(event)); });
    svg.addEventListener("pointermove", (event) => { if (event.buttons) goTo(plot.under(event)); });
    return {...one, plot, cursor, keys};
  });
}

function drawHeat(plot, weights) {
  const size = plot.x(1) - plot.x(0);
  const tall = plot.y(0) - plot.y(1);
  const layer = add(plot.svg, "g", {colour: DATA.palette[0]});
  weights.forEach((row, t) => row.forEach((weight, i) => {
    if (weight < 0.005) return;
    add(layer, "rect", {x: plot.x(t) - size / 2, y: plot.y(i) - tall / 2, width: size, height: tall,
                        fill: "currentColor", "fill-opacity": Math.min(1, weight).toFixed(2)});
  }));
}

function goTo(step) {
  const shown = chosenRun();
  const episode = chosenEpisode();
  const last = episode.reward.length - 1;
  player.step = Math.min(Math.max(Math.round(step), 0), last);
  const t = player.step;
  const slider = byId("position");
  slider.max = last;
  slider.value = t;
  drawPanels(shown, episode, t);
  for (const {plot, cursor, keys, lines, taken, heat} of player.strips) {
    cursor.setAttribute("x1", plot.x(t));
    cursor.setAttribute("x2", plot.x(t));
    keys.replaceChildren();
    for (const line of lines) {
      const chosen = taken && t < last && line.action === episode.action[t];
      const key = add(keys, "div", {class: chosen ? "taken" : ""});
      add(add(key, "i", {colour: line.colour}), "i", {class: `swatch ${line.kind ?? ""}`});
      add(key, "span", {}, `${line.name} ${decimal(line.values[t])}`);
    }
    if (heat) add(keys, "div", {}, player.head < 0 ? "mean over heads" : `head ${player.head + 1}`);
  }
  byId("moment").textContent = sentence(shown, episode, t, last);
  slider.setAttribute("aria-valuetext", byId("moment").textContent);
}

function sentence(shown, episode, t, last) {
  const parts = [`Step ${t} of ${last}`];
  if (t > 0) parts.push(`reward ${decimal(episode.reward[t])}`);
  if (t > 0 && episode.bonus) parts.push(`bonus ${decimal(shown.weight * episode.bonus[t])}`);
  if (episode.reveals[t]) parts.push("sees what is otherwise hidden");
  const action = episode.action[t];
  if (t === last) parts.push("the end");
  else parts.push(shown.discrete ? `goes on with: ${shown.actions[action]}`
    : `goes on with: ${shown.actions.map((name, a) => `${name} ${decimal(action[a])}`).join(", ")}`);
  return `${parts.join("; ")}.`;
}

function play(on) {
  clearInterval(player.timer);
  player.timer = null;
  const button = byId("play");
  if (on) {
    if (player.step >= chosenEpisode().reward.length - 1) goTo(0);
    player.timer = setInterval(() => {
      if (player.step >= chosenEpisode().reward.length - 1) play(false);
      else goTo(player.step + 1);
    }, 450);
  }
  button.querySelector("path").setAttribute("d", on ? PAUSE : PLAY);
  button.setAttribute("aria-label", on ? "Pause" : "Play");
}

function chooseRun(run) {
  player.run = run;
  player.episode = 0;
  player.head = -1;
  const shown = DATA.runs[run].episodes;
  const playable = shown !== null && typeof shown !== "string";
  byId("episode-body").hidden = !playable;
  byId("episode-missing").textContent = playable
    ? `Greedy, seed ${shown.seed}, checkpoint of step ${readable(shown.step, true)}.`
    : `No episode of this run: ${shown ?? "none was played"}.`;
  byId("episode-label").hidden = byId("head-label").hidden = !playable;
  if (!playable) return;
  select(byId("episode-number"), shown.episodes.map((episode, i) => {
    const steps = episode.reward.length - 1;
    const hidden = shown.variables.map((variable, v) =>
      variable.hidden ? `, ${heading(variable.name)} ${shortest(episode.truth[0][v])}` : "");
    const reward = readable(episode.reward.reduce((sum, value) => sum + value, 0));
    return [i, `${i + 1}: ${steps} steps, reward ${reward}${hidden.join("")}`];
  }));
  byId("episode-label").hidden = shown.episodes.length < 2;
  const heads = shown.episodes[0].attention?.length ?? 0;
  byId("head-label").hidden = heads < 2;
  select(byId("head"), [[-1, "mean"], ...Array.from({length: heads}, (_, i) => [i, String(i + 1)])]);
  drawSeries();
  goTo(0);
}

(function startEpisodes() {
  const controls = byId("episode-choice");
  const labelled = (text, id, hidden = false) => {
    const label = add(controls, "label", {id: `${id}-label`, hidden});
    label.append(`${text} `);
    return label;
  };
  const menu = add(labelled("Run", "episode-run", DATA.runs.length < 2), "select", {id: "episode-run"});
  select(menu, DATA.runs.map((run, i) => [i, run.label]));
  const number = add(labelled("Episode", "episode"), "select", {id: "episode-number"});
  const head = add(labelled("Attention head", "head"), "select", {id: "head"});
  const buttons = byId("episode-buttons");
  for (const [id, sign, label, act] of [
    ["first", "M3 2V14M14 2L5 8L14 14Z", "First step", () => goTo(0)],
    ["back", "M11 2L3 8L11 14", "One step back", () => goTo(player.step - 1)],
    ["play", PLAY, "Play", () => play(player.timer === null)],
    ["on", "M5 2L13 8L5 14", "One step on", () => goTo(player.step + 1)],
    ["last", "M13 2V14M2 2L11 8L2 14Z", "Last step", () => goTo(Infinity)],
  ]) {
    const button = add(buttons, "button", {type: "button", id, "aria-label": label, title: label});
    add(add(button, "svg", {class: "sign", viewBox: "0 0 16 16", "aria-hidden": "true"}), "path", {d: sign});
    button.addEventListener("click", () => {
      if (id !== "play") play(false);
      act();
    });
  }
  menu.addEventListener("change", () => { play(false); chooseRun(Number(menu.value)); });
  number.addEventListener("change", () => {
    play(false);
    player.episode = Number(number.value);
    drawSeries();
    goTo(0);
  });
  head.addEventListener("change", () => { player.head = Number(head.value); drawSeries(); goTo(player.step); });
  byId("position").addEventListener("input", (event) => { play(false); goTo(Number(event.target.value)); });
  byId("episode").addEventListener("keydown", (event) => {
    if (byId("episode-body").hidden || event.ctrlKey || event.altKey || event.metaKey) return;
    const kind = event.target.tagName;
    if (kind === "SELECT" || (kind === "BUTTON" && (event.key === " " || event.key === "Enter"))) return;
    const act = {ArrowLeft: () => goTo(player.step - 1), ArrowRight: () => goTo(player.step + 1), Home: () => goTo(0),
                 End: () => goTo(Infinity)}[event.key];
    if (event.key === " ") play(player.timer === null);
    else if (act) { play(false); act(); } else return;
    event.preventDefault();
  });
  const first = DATA.runs.findIndex((run) => run.episodes !== null && typeof run.episodes !== "string");
  menu.value = Math.max(first, 0);
  chooseRun(Math.max(first, 0));
  onResize(byId("series"), () => {
    if (!byId("episode-body").hidden) { drawSeries(); goTo(player.step); }
  });
})();

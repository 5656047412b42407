// The tables: the same numbers as runs.csv and seeds.csv, sorted by any column.
const COUNTS = ["seed", "seeds", "steps", "steps_to_solve"];

function sortedTable(box, name, columns, lines) {
  // columns: {title, value(line), text(line)?, number?, count?}
  const scroll = add(box, "div", {class: "scroll", tabindex: 0, role: "region", "aria-label": name});
  const table = add(scroll, "table");
  const head = add(add(table, "thead"), "tr");
  const body = add(table, "tbody");
  const heads = columns.map((column) => {
    const cell = add(head, "th", {scope: "col", class: column.number ? "number" : "", "aria-sort": "none"});
    add(cell, "button", {type: "button"}, column.title).addEventListener("click", () => sortBy(column, cell));
    return cell;
  });
  function sortBy(column, cell) {
    const rising = cell.getAttribute("aria-sort") !== "ascending";
    heads.forEach((other) => other.setAttribute("aria-sort", "none"));
    cell.setAttribute("aria-sort", rising ? "ascending" : "descending");
    fill([...lines].sort((a, b) => {
      const [x, y] = [column.value(a), column.value(b)];
      if (x === null || y === null) return (x === null) - (y === null);  // what is empty comes last
      return (rising ? 1 : -1) * (typeof x === "number" ? x - y : String(x).localeCompare(String(y)));
    }));
  }
  function fill(ordered) {
    body.replaceChildren();
    for (const line of ordered) {
      const row = add(body, "tr");
      for (const column of columns) {
        const cell = add(row, "td", {class: column.number ? "number" : ""});
        const run = column.title === "run" ? DATA.runs.find((known) => known.label === line.run) : null;
        if (run) add(add(cell, "span", {colour: run.colour}), "span", {class: "swatch"});
        cell.append(column.text ? column.text(line) : readable(column.value(line), column.count));
      }
    }
  }
  fill(lines);
}

function columnsOf(lines) {
  // A quantity's mean and standard deviation make one column, and so do an estimate and its interval.
  const names = [...new Set(lines.flatMap((line) => Object.keys(line)))];
  const columns = [];
  for (const name of names) {
    const used = lines.some((line) => line[name] !== null && line[name] !== undefined);
    if (!used || /_(std|low|high)$/.test(name) || (name === "domain" && domains.length < 2)) continue;
    const value = (line) => line[name] ?? null;
    const number = lines.some((line) => typeof line[name] === "number");
    if (name.endsWith("_mean")) {
      const base = name.slice(0, -5);
      columns.push({title: heading(base), number, value, text: (line) => value(line) === null ? ""
        : readable(value(line)) + (line.seeds > 1 ? ` ± ${readable(line[`${base}_std`])}` : "")});
    } else if (name.endsWith("_iqm")) {
      if (lines.every((line) => line.seeds < 2)) continue;
      columns.push({title: `${heading(name.slice(0, -4))}, IQM [95\u00a0%]`, number, value, text: (line) =>
        value(line) === null ? ""
        : `${readable(value(line))} [${readable(line[`${name}_low`])}, ${readable(line[`${name}_high`])}]`});
    } else if (name === "solved") {
      columns.push({title: "solved", number, value, text: (line) => `${line.solved}/${line.seeds}`});
    } else {
      columns.push({title: name.startsWith("wall") ? `${heading(name.replace(/^wall_/, ""))}\u00a0s` : heading(name),
                    number, count: COUNTS.includes(name), value});
    }
  }
  return columns;
}

function fillOptions(all) {
  let box = byId("option-table");
  box.replaceChildren();
  const lines = DATA.options.filter((line) => all || line.differs);
  if (!lines.length) {
    add(box, "p", {class: "missing"},
        DATA.options.length ? "The runs' options do not differ." : "No options were kept.");
    return;
  }
  if (all) {
    box = add(box, "details", {open: DATA.runs.length > 1});
    add(box, "summary", {}, `all ${lines.length} options`);
  }
  const scroll = add(box, "div", {class: "scroll", tabindex: 0, role: "region", "aria-label": "Options of the runs"});
  const table = add(scroll, "table");
  const head = add(add(table, "thead"), "tr");
  add(head, "th", {scope: "col"}, "option");
  for (const run of DATA.runs) {
    const cell = add(head, "th", {scope: "col"});
    add(add(cell, "span", {colour: run.colour}), "span", {class: "swatch"});
    cell.append(run.label);
  }
  const body = add(table, "tbody");
  for (const line of lines) {
    const row = add(body, "tr");
    add(row, "th", {scope: "row"}, line.name);
    for (const value of line.values) add(row, "td", {class: "option"}, value ?? "–");
  }
}

(function startTables() {
  sortedTable(byId("run-table"), "Runs", columnsOf(DATA.run_table), DATA.run_table);
  sortedTable(byId("seed-table"), "Seeds", columnsOf(DATA.seed_table), DATA.seed_table);
  byId("table-note").textContent = "Mean ± standard deviation over seeds; steps to the first evaluation with success "
    + `≥ ${DATA.solved} (of a run: the median); seconds of wall time.`;
  const several = DATA.runs.length > 1;
  if (several) {
    const label = add(byId("options-controls"), "label");
    const tick = add(label, "input", {type: "checkbox", id: "only-differences", checked: true});
    label.append(" only what differs");
    tick.addEventListener("change", () => fillOptions(!tick.checked));
  }
  fillOptions(!several);
})();

// What all parts of the page share: the data, elements, numbers.
const DATA = JSON.parse(document.getElementById("data").textContent);
const SVG = document.querySelector("svg").namespaceURI;
const byId = (id) => document.getElementById(id);

function add(parent, name, attributes = {}, text = null) {
  const drawn = parent.namespaceURI === SVG || name === "svg";
  const made = drawn ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value !== null && value !== false && key !== "colour") made.setAttribute(key, value === true ? "" : value);
  }
  if (attributes.colour) {
    made.classList.add("coloured");
    made.style.setProperty("--colour", attributes.colour);
  }
  if (text !== null) made.textContent = text;
  parent.appendChild(made);
  return made;
}

function select(menu, choices, chosen) {
  // choices: [value, text, group or undefined]
  menu.replaceChildren();
  const groups = new Map();
  for (const [value, text, group] of choices) {
    if (group !== undefined && !groups.has(group)) groups.set(group, add(menu, "optgroup", {label: group}));
    add(groups.get(group) ?? menu, "option", {value}, text);
  }
  if (chosen !== undefined) menu.value = chosen;
}

// As mijax.tables.readable: counts and large numbers with thousands apart, others to three digits or so. JSON does not
// tell 1.0 from 1, so who calls has to say what is a count.
function readable(value, count = false) {
  if (value === null || value === undefined) return "";
  if (typeof value === "string") return value;
  const size = Math.abs(value);
  if (count || size >= 1000) return Math.round(value).toLocaleString("en");
  if (size >= 10) return value.toFixed(1);
  if (size > 0 && size < 0.001) return value.toExponential(1);
  return (Math.round(value * 1000) / 1000 + 0).toFixed(3);
}

function decimal(value) {
  return value === null || value === undefined ? "–" : value.toFixed(3).replace(/^-0\.000$/, "0.000");
}

// At most three digits, and none that say nothing: classes are numbers too.
const shortest = (value) => value === null ? "–" : String(Number(value.toFixed(3)));

function heading(name) {
  const known = {discounted_return: "discounted", fraction_of_optimum: "of optimum"};
  return known[name] ?? name.replaceAll("_", " ");
}

function nearest(sorted, value) {
  let best = 0;
  for (let i = 1; i < sorted.length; i++) {
    if (Math.abs(sorted[i] - value) < Math.abs(sorted[best] - value)) best = i;
  }
  return best;
}

const domains = [...new Set(DATA.runs.map((run) => run.domain))];
byId("title").textContent = domains.map((domain) => DATA.names[domain]).join(", ");
document.title = `${byId("title").textContent} – mijax`;
byId("note").textContent = [
  DATA.runs.map((run) => run.label).join(" · "),
  DATA.smooth > 1 ? `curves: running mean over ${DATA.smooth} evaluations` : "",
  DATA.note,
].filter(Boolean).join("; ");

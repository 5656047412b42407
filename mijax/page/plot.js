// Axes and lines in SVG, in pixels of the page, so that letters keep their size at any width.
function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((size) => size >= rough * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) {
    found.push(Number((i * step).toPrecision(12)));
  }
  return found;
}

function shortNumber(value) {
  for (const [size, letter] of [[1e6, "M"], [1e3, "k"]]) {
    if (Math.abs(value) >= size) return `${Number((value / size).toPrecision(4))}${letter}`;
  }
  return String(Number(value.toPrecision(4)));
}

class Plot {
  // x, y: [low, high]; what is left of a former drawing is removed.
  // What is drawn in `inside` is cut at the axes.
  constructor(svg, {height, x, y, label = "", wholeTicks = false, wholeHeights = false, left = 0}) {
    this.svg = svg;
    this.width = Math.max(svg.getBoundingClientRect().width, 200);
    this.height = height;
    const yTicks = ticks(y[0], y[1], height > 200 ? 6 : 3).filter((tick) => !wholeHeights || Number.isInteger(tick));
    const letters = Math.max(...yTicks.map((tick) => shortNumber(tick).length));
    this.left = Math.max(left, 14 + 7 * letters);
    this.right = this.width - 8;
    this.top = 8;
    this.bottom = height - (label ? 38 : 22);
    this.xs = x;
    this.ys = y;
    svg.replaceChildren();
    svg.setAttribute("viewBox", `0 0 ${this.width} ${height}`);
    svg.setAttribute("height", height);
    for (const tick of yTicks) {
      add(svg, "line", {class: "rule", x1: this.left, x2: this.right, y1: this.y(tick), y2: this.y(tick)});
      add(svg, "text", {x: this.left - 6, y: this.y(tick) + 4, "text-anchor": "end"}, shortNumber(tick));
    }
    let xTicks = ticks(x[0], x[1], Math.min(8, this.width / 90));
    if (wholeTicks) xTicks = xTicks.filter(Number.isInteger);
    for (const tick of xTicks) {
      const end = this.x(tick) > this.right - 14 ? "end" : "middle";
      add(svg, "text", {x: end === "end" ? this.right : this.x(tick), y: this.bottom + 16, "text-anchor": end},
          shortNumber(tick));
    }
    const frame = {x: this.left, y: this.top - 4, width: this.right - this.left, height: this.bottom - this.top + 4};
    const clip = add(svg, "clipPath", {id: `clip-${Plot.made = (Plot.made ?? 0) + 1}`});
    add(clip, "rect", frame);
    this.inside = add(svg, "g", {"clip-path": `url(#${clip.id})`});
    add(svg, "line", {class: "axis", x1: this.left, x2: this.right, y1: this.bottom, y2: this.bottom});
    add(svg, "line", {class: "axis", x1: this.left, x2: this.left, y1: this.top, y2: this.bottom});
    if (label) {
      add(svg, "text", {x: (this.left + this.right) / 2, y: height - 4, "text-anchor": "middle"}, label);
    }
  }

  x(value) {
    return this.left + (this.right - this.left) * (value - this.xs[0]) / (this.xs[1] - this.xs[0]);
  }

  y(value) {
    return this.bottom - (this.bottom - this.top) * (value - this.ys[0]) / (this.ys[1] - this.ys[0]);
  }

  // The value on the x axis under a pointer.
  under(event) {
    const box = this.svg.getBoundingClientRect();
    const across = (event.clientX - box.left) * this.width / box.width;
    return this.xs[0] + (this.xs[1] - this.xs[0]) * (across - this.left) / (this.right - this.left);
  }

  heightUnder(event) {
    const box = this.svg.getBoundingClientRect();
    return (event.clientY - box.top) * this.height / box.height;
  }

  line(xs, ys, attributes) {
    let path = "";
    let down = false;
    xs.forEach((x, i) => {
      if (ys[i] === null) { down = false; return; }
      path += `${down ? "L" : "M"}${this.x(x).toFixed(1)} ${this.y(ys[i]).toFixed(1)}`;
      down = true;
    });
    const {class: kind = "", ...others} = attributes;
    return add(this.inside, "path", {...others, class: `curve ${kind}`, d: path});
  }

  band(xs, low, high, attributes) {
    const above = xs.map((x, i) => `${this.x(x).toFixed(1)} ${this.y(high[i]).toFixed(1)}`);
    const below = xs.map((x, i) => `${this.x(x).toFixed(1)} ${this.y(low[i]).toFixed(1)}`).reverse();
    return add(this.inside, "path", {...attributes, class: "band", d: `M${above.concat(below).join("L")}Z`});
  }

  upright(value, attributes) {
    const place = this.x(value);
    return add(this.svg, "line", {...attributes, x1: place, x2: place, y1: this.top, y2: this.bottom});
  }
}

// The smallest interval that holds all values, a little widened; never empty.
function span(values, fixed = null) {
  if (fixed) return fixed;
  const finite = values.filter((value) => value !== null && Number.isFinite(value));
  if (!finite.length) return [0, 1];
  let low = finite[0];
  let high = finite[0];
  for (const value of finite) {
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  const room = 0.06 * (high - low) || 0.1 * Math.abs(high) || 0.5;
  return [low - room, high + room];
}

function onResize(target, draw) {
  let width = 0;
  new ResizeObserver(() => {
    const now = target.getBoundingClientRect().width;
    if (Math.abs(now - width) > 1) {
      width = now;
      draw();
    }
  }).observe(target);
}

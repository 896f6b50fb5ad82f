// Points over two axes, and over several parallel ones, on a canvas.

import { element, number } from "./common.js";

const INK = "#1c2329", SOFT = "#5d6870", LINE = "#d9dee2", BAD = "#b2182b", BEST = "#d6604d", DROPPED = "#9aa3a9";
const MARGIN = { left: 62, right: 14, top: 10, bottom: 34 };
const MANY = 3000; // points that are drawn as dots
const REACH = 14; // px: how near the pointer must be to a point
const VIRIDIS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

// The colour at u in [0, 1]: bright is good.
export function color(u, opacity = 1) {
  if (!Number.isFinite(u)) return DROPPED;
  const place = Math.min(Math.max(u, 0), 1) * (VIRIDIS.length - 1);
  const k = Math.min(Math.floor(place), VIRIDIS.length - 2);
  const mix = VIRIDIS[k].map((a, i) => Math.round(a + (place - k) * (VIRIDIS[k + 1][i] - a)));
  return `rgba(${mix.join(",")},${opacity})`;
}

// The scale of an axis: {label, lower, upper, log, integer, options}; options stand side by side.
export class Scale {
  constructor({ label, lower, upper, log = false, options = null }) {
    Object.assign(this, { label, log, options });
    [this.lower, this.upper] = options ? [-0.5, options.length - 0.5] : [lower, upper];
    if (!(this.lower < this.upper)) [this.lower, this.upper] = [this.lower - 0.5, this.upper + 0.5];
  }

  unit(value) {
    if (this.log) return Math.log(value / this.lower) / Math.log(this.upper / this.lower);
    return (value - this.lower) / (this.upper - this.lower);
  }

  value(unit) {
    if (this.options) return Math.min(Math.max(Math.round(this.lower + unit * (this.upper - this.lower)), 0), this.options.length - 1);
    unit = Math.min(Math.max(unit, 0), 1);
    if (this.log) return this.lower * (this.upper / this.lower) ** unit;
    return this.lower + unit * (this.upper - this.lower);
  }

  ticks(count) {
    if (this.options) return this.options.map((option, k) => [k, String(option)]);
    if (this.log) {
      const places = [];
      for (let e = Math.floor(Math.log10(this.lower)); e <= Math.ceil(Math.log10(this.upper)); e++) {
        for (const m of [1, 2, 5]) places.push(m * 10 ** e);
      }
      const inside = places.filter((v) => v >= this.lower * 0.999 && v <= this.upper * 1.001);
      const decades = inside.filter((v) => Math.abs(Math.log10(v) % 1) < 1e-9);
      return (inside.length > count && decades.length > 1 ? decades : inside).map((v) => [v, number(v)]);
    }
    const rough = (this.upper - this.lower) / count, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
    const ticks = [];
    for (let k = Math.ceil(this.lower / step - 1e-9); k * step <= this.upper + 1e-9 * step; k++) ticks.push([k * step, number(k * step)]);
    return ticks;
  }
}

// What the charts have in common: a canvas of the size of its place, drawn at most once per animation frame. The points
// are drawn once, on a layer of their own; over it lies what follows the pointer.
class Chart {
  // `height` is a part of the window's; `drags` tells what a drag draws at present: "box", "target" or nothing.
  constructor(id, { height, onpoint, onleave, onclick, ondrag, drags = () => "" }) {
    Object.assign(this, { part: height, onpoint, onclick, ondrag, drags });
    this.canvas = element("canvas", { id, className: "vtb-chart", tabIndex: 0 });
    this.layer = document.createElement("canvas");
    this.pointed = -1;
    this.draws = 0;
    this.canvas.addEventListener("pointermove", (event) => this.#move(event));
    this.canvas.addEventListener("pointerleave", () => onleave?.());
    this.canvas.addEventListener("pointerdown", (event) => this.#press(event));
    this.canvas.addEventListener("pointerup", (event) => this.#release(event));
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
  }

  #place({ offsetX, offsetY }) {
    return [offsetX, offsetY];
  }

  #move(event) {
    if (this.pressed) {
      this.dragged = this.#place(event);
      if (this.drags()) this.redraw();
      return;
    }
    const index = this.near(...this.#place(event));
    this.canvas.style.cursor = index !== -1 ? "pointer" : "crosshair";
    this.onpoint?.(index);
  }

  #press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pressed = this.#place(event);
    this.dragged = null;
  }

  #release(event) {
    const [from, to] = [this.pressed, this.#place(event)];
    this.pressed = this.dragged = null;
    if (!from) return;
    if (Math.hypot(to[0] - from[0], to[1] - from[1]) < 5) this.onclick?.(this.near(...to), ...this.values(...to));
    else if (this.drags()) this.ondrag(this.values(...from), this.values(...to));
    this.redraw();
  }

  // Marks a point, -1 for none.
  point(index) {
    this.pointed = index;
    this.redraw();
  }

  redraw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      const ratio = devicePixelRatio, width = this.canvas.clientWidth;
      if (!width || !this.data) return;
      this.width = width;
      this.height = Math.max(110, Math.round(this.part * innerHeight));
      this.canvas.style.height = `${this.height}px`;
      const size = [Math.round(width * ratio), Math.round(this.height * ratio)];
      if (this.layer.width !== size[0] || this.layer.height !== size[1]) {
        for (const canvas of [this.canvas, this.layer]) [canvas.width, canvas.height] = size;
        this.stale = true;
      }
      if (this.stale) {
        this.draw(this.#pen(this.layer, ratio));
        this.canvas.dataset.points = this.data.kind.length;
      }
      this.stale = false;
      const pen = this.#pen(this.canvas, 1);
      pen.drawImage(this.layer, 0, 0);
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      this.overlay(pen);
      this.canvas.dataset.draws = ++this.draws;
    });
  }

  #pen(canvas, ratio) {
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.font = "11px system-ui, sans-serif";
    return pen;
  }
}

// Points over two axes. `data` is {x, y: arrays of values, color: index -> colour, kind: array, best, line: [[x, y], ...]},
// with marks [{at: [x, y], tint, shape, index}]: those with an index, which is below -1, can be pointed at as points are.
export class Scatter extends Chart {
  show(data, xScale, yScale) {
    Object.assign(this, { data, xScale, yScale, stale: true });
    this.redraw();
  }

  x(value) {
    return MARGIN.left + this.xScale.unit(value) * (this.width - MARGIN.left - MARGIN.right);
  }

  y(value) {
    return this.height - MARGIN.bottom - this.yScale.unit(value) * (this.height - MARGIN.top - MARGIN.bottom);
  }

  values(px, py) {
    return [
      this.xScale.value((px - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right)),
      this.yScale.value((this.height - MARGIN.bottom - py) / (this.height - MARGIN.top - MARGIN.bottom)),
    ];
  }

  near(px, py) {
    if (!this.data) return -1;
    let [nearest, least] = [-1, REACH];
    for (let k = 0; k < this.data.x.length; k++) {
      const distance = Math.hypot(this.x(this.data.x[k]) - px, this.y(this.#height(k)) - py);
      if (distance < least) [nearest, least] = [k, distance];
    }
    for (const { at, index } of this.data.marks ?? []) {
      const distance = Math.hypot(this.x(at[0]) - px, this.y(at[1]) - py);
      if (index && distance < least) [nearest, least] = [index, distance];
    }
    return nearest;
  }

  // A trial without a value lies at the bottom.
  #height(k) {
    return this.data.y[k] ?? this.yScale.value(0.02);
  }

  draw(pen) {
    const { grid, x, kind, line, best, marks = [], regions = [] } = this.data;
    if (grid?.mean) this.#cells(pen, grid);
    this.#axes(pen);
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left - 10, MARGIN.top - 10, this.width - MARGIN.left - MARGIN.right + 20, this.height - MARGIN.top - MARGIN.bottom + 20);
    pen.clip();
    for (const [x0, y0, x1, y1] of regions) this.#box(pen, this.x(x0), this.y(y0), this.x(x1), this.y(y1));
    if (line?.length) {
      pen.strokeStyle = BEST;
      pen.lineWidth = 1.5;
      pen.beginPath();
      line.forEach(([a, b], k) => pen[k ? "lineTo" : "moveTo"](this.x(a), this.y(b)));
      pen.stroke();
    }
    const many = x.length > MANY, size = many ? 1.5 : 3.5;
    for (let k = 0; k < x.length; k++) {
      point(pen, this.x(x[k]), this.y(this.#height(k)), size, kind[k], this.data.color(k), many ? "dot" : grid?.mean ? "framed" : "");
    }
    if (best >= 0) ring(pen, this.x(x[best]), this.y(this.#height(best)), 8, BEST);
    for (const { at, tint, shape } of marks) mark(pen, this.x(at[0]), this.y(at[1]), tint, shape);
    pen.restore();
  }

  overlay(pen) {
    const { x, marks = [] } = this.data, k = this.pointed;
    const at = marks.find(({ index }) => index && index === k)?.at;
    if (at) ring(pen, this.x(at[0]), this.y(at[1]), 10, "#cc3399");
    if (k >= 0 && k < x.length) ring(pen, this.x(x[k]), this.y(this.#height(k)), 7, "#cc3399");
    const shape = this.pressed && this.dragged && this.drags();
    if (shape === "box") this.#box(pen, ...this.pressed, ...this.dragged);
    if (shape === "target") mark(pen, ...this.dragged, "#0b6e99", "target");
  }

  #box(pen, x0, y0, x1, y1) {
    pen.fillStyle = "rgba(178, 24, 43, 0.18)";
    pen.strokeStyle = BAD;
    pen.lineWidth = 1;
    pen.fillRect(x0, y0, x1 - x0, y1 - y0);
    pen.strokeRect(x0, y0, x1 - x0, y1 - y0);
  }

  #cells(pen, { x, y, mean }) {
    // Whole pixels: cells that overlap would show a net.
    const columns = edges(this.xScale, x).map((u) => Math.round(MARGIN.left + u * (this.width - MARGIN.left - MARGIN.right)));
    const rows = edges(this.yScale, y).map((u) => Math.round(this.height - MARGIN.bottom - u * (this.height - MARGIN.top - MARGIN.bottom)));
    mean.forEach((row, j) =>
      row.forEach((value, i) => {
        pen.fillStyle = this.data.shade(value);
        pen.fillRect(columns[i], rows[j + 1], columns[i + 1] - columns[i], rows[j] - rows[j + 1]);
      }),
    );
  }

  #axes(pen) {
    const { left, right, top, bottom } = MARGIN, [width, height] = [this.width, this.height];
    pen.strokeStyle = LINE;
    pen.fillStyle = SOFT;
    pen.lineWidth = 1;
    pen.strokeRect(left, top, width - left - right, height - top - bottom);
    pen.textAlign = "center";
    for (const [value, text] of this.xScale.ticks(Math.max(2, width / 90))) {
      const at = this.x(value);
      pen.fillRect(at, height - bottom, 1, 4);
      pen.fillText(text, at, height - bottom + 14);
    }
    pen.textAlign = "right";
    for (const [value, text] of this.yScale.ticks(Math.max(2, height / 45))) {
      pen.fillRect(left - 4, this.y(value), 4, 1);
      pen.fillText(String(text).slice(0, 9), left - 6, this.y(value) + 4);
    }
    pen.fillStyle = INK;
    pen.fillText(fitted(pen, this.xScale.label, width - left - right), width - right, height - 5);
    pen.save();
    pen.translate(11, top);
    pen.rotate(-Math.PI / 2);
    pen.fillText(fitted(pen, this.yScale.label, height - top - bottom), 0, 0);
    pen.restore();
  }
}

// One line per trial over all parameters and qualities, side by side. `data` is {columns: arrays, color, kind, order},
// with marks [{at: values, tint, index}], which are broken lines and can be pointed at as in `Scatter`.
export class Parallel extends Chart {
  show(data, scales) {
    Object.assign(this, { data, scales, stale: true });
    this.redraw();
  }

  x(axis) {
    return 24 + (axis / Math.max(1, this.scales.length - 1)) * (this.width - 48);
  }

  y(axis, value) {
    const scale = this.scales[axis];
    return this.height - 30 - scale.unit(value ?? scale.lower) * (this.height - 52);
  }

  values() {
    return [];
  }

  near(px, py) {
    if (!this.data) return -1;
    const axes = this.scales.length - 1, place = ((px - 24) / (this.width - 48)) * axes;
    const left = Math.min(Math.max(Math.floor(place), 0), axes - 1), share = place - left;
    let [nearest, least] = [-1, REACH];
    const { columns, kind, marks = [] } = this.data;
    const measure = (index, from, to) => {
      const [a, b] = [this.y(left, from), this.y(left + 1, to)];
      const distance = Math.abs(a + share * (b - a) - py);
      if (distance < least) [nearest, least] = [index, distance];
    };
    for (let k = 0; k < kind.length; k++) measure(k, columns[left][k], columns[left + 1][k]);
    for (const { at, index } of marks) measure(index, at[left], at[left + 1]);
    return nearest;
  }

  #values(index) {
    const { columns, kind, marks = [] } = this.data;
    if (index >= 0) return index < kind.length ? columns.map((column) => column[index]) : null;
    return marks.find((mark) => mark.index === index)?.at;
  }

  draw(pen) {
    const { color: tint, order, best, marks = [] } = this.data;
    pen.globalAlpha = Math.min(1, Math.max(0.06, 150 / order.length));
    pen.lineWidth = 1;
    for (const k of order) this.#line(pen, this.#values(k), tint(k));
    pen.globalAlpha = 1;
    pen.lineWidth = 2.5;
    if (best >= 0) this.#line(pen, this.#values(best), BEST);
    pen.lineWidth = 1.5;
    pen.setLineDash([6, 4]);
    for (const { at, tint } of marks) this.#line(pen, at, tint);
    pen.setLineDash([]);
    this.scales.forEach((scale, axis) => {
      const at = this.x(axis);
      pen.fillStyle = SOFT;
      pen.fillRect(at, 22, 1, this.height - 52);
      pen.textAlign = axis === 0 ? "left" : axis === this.scales.length - 1 ? "right" : "center";
      const shift = axis === 0 ? -20 : axis === this.scales.length - 1 ? 20 : 0;
      pen.fillText(scale.options ? scale.options.at(-1) : number(scale.upper), at + shift, 16);
      pen.fillText(scale.options ? scale.options[0] : number(scale.lower), at + shift, this.height - 18);
      pen.fillStyle = INK;
      pen.fillText(fitted(pen, scale.label, (this.width - 48) / this.scales.length), at + shift, this.height - 5);
    });
  }

  overlay(pen) {
    pen.lineWidth = 2.5;
    const values = this.#values(this.pointed);
    if (values) this.#line(pen, values, "#cc3399");
  }

  #line(pen, values, tint) {
    pen.strokeStyle = tint;
    pen.beginPath();
    values.forEach((value, axis) => pen[axis ? "lineTo" : "moveTo"](this.x(axis), this.y(axis, value)));
    pen.stroke();
  }
}

function edges(scale, centres) {
  const units = centres.map((value) => scale.unit(value));
  const middles = units.slice(1).map((u, k) => (u + units[k]) / 2);
  return [0, ...middles, 1];
}

// The end of a label is what tells addresses apart.
function fitted(pen, text, width) {
  if (pen.measureText(text).width <= width) return text;
  let shown = text;
  while (shown.length > 4 && pen.measureText(`…${shown}`).width > width) shown = shown.slice(1);
  return `…${shown}`;
}

function point(pen, x, y, size, kind, tint, style) {
  if (kind === "failed") {
    pen.strokeStyle = BAD;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(x - size, y - size);
    pen.lineTo(x + size, y + size);
    pen.moveTo(x - size, y + size);
    pen.lineTo(x + size, y - size);
    pen.stroke();
    return;
  }
  if (style === "dot") {
    pen.fillStyle = kind === "broken" ? "#f4a582" : kind === "dropped" ? DROPPED : tint;
    pen.fillRect(x - size, y - size, 2 * size, 2 * size);
    return;
  }
  pen.beginPath();
  if (kind === "dropped") {
    pen.moveTo(x - size, y - size);
    pen.lineTo(x + size, y - size);
    pen.lineTo(x, y + size);
    pen.closePath();
    pen.fillStyle = DROPPED;
    pen.fill();
    return;
  }
  pen.arc(x, y, size, 0, 2 * Math.PI);
  if (kind === "broken") {
    pen.strokeStyle = "#f4a582";
    pen.lineWidth = 1.5;
    pen.stroke();
    return;
  }
  pen.fillStyle = tint;
  pen.fill();
  if (style === "framed") {
    pen.strokeStyle = "rgba(255,255,255,0.8)";
    pen.lineWidth = 0.8;
    pen.stroke();
  }
}

function ring(pen, x, y, size, tint) {
  pen.strokeStyle = tint;
  pen.lineWidth = 2.5;
  pen.beginPath();
  pen.arc(x, y, size, 0, 2 * Math.PI);
  pen.stroke();
}

function mark(pen, x, y, tint, shape) {
  pen.strokeStyle = tint;
  pen.lineWidth = 2;
  pen.beginPath();
  if (shape === "cross") {
    pen.moveTo(x - 9, y);
    pen.lineTo(x + 9, y);
    pen.moveTo(x, y - 9);
    pen.lineTo(x, y + 9);
  } else if (shape === "diamond") {
    pen.moveTo(x, y - 7);
    for (const [dx, dy] of [[6, 0], [0, 7], [-6, 0]]) pen.lineTo(x + dx, y + dy);
    pen.closePath();
    pen.fillStyle = "rgba(255,255,255,0.8)";
    pen.fill();
  } else if (shape === "target") {
    pen.arc(x, y, 8, 0, 2 * Math.PI);
    pen.moveTo(x + 3, y);
    pen.arc(x, y, 3, 0, 2 * Math.PI);
  } else {
    pen.rect(x - 5, y - 5, 10, 10);
  }
  pen.stroke();
}

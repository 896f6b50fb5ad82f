// Points over two axes, and over several parallel ones, on a canvas.

import { element } from "./common.js";
import { palette } from "./palette.js";
import { Scale, edges, fitted } from "./scale.js";
import { mark, point, ring } from "./symbols.js";

const MARGIN = { left: 52, right: 14, top: 24, bottom: 34 };
const SIDE = 24; // px beside the first and the last of parallel axes
const [ABOVE, BELOW] = [22, 44]; // px above and below parallel axes
const MANY = 3000; // points that are drawn as dots
const REACH = 14; // px: how near the pointer must be to a point
const STEPS = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 };

/** @typedef {{trial?: number, drive?: number} | null} Pointed a trial, or a rollout driven by hand; null for nothing */

/**
 * A mark of something that is no trial: `at` its values, `pick` what the pointer has there.
 *
 * @typedef {{at: number[], tint: string, shape: string, pick: Pointed}} Mark
 */

/**
 * What a chart does with the pointer, and with the keys. `drags` tells what a drag draws at present: "box", "target" or
 * nothing; `onclick` gets what is there and the values there.
 *
 * @typedef {{
 *   title: string,
 *   height: number,
 *   onpoint: (pick: Pointed) => void,
 *   onkeep: (pick: Pointed) => void,
 *   onclick?: (pick: Pointed, values: number[]) => void,
 *   ondrag?: (from: number[], to: number[]) => void,
 *   drags?: () => string,
 * }} Events
 */

/**
 * @param {Pointed | undefined} a
 * @param {Pointed | undefined} b
 * @returns {boolean} whether they are the same
 */
export function isSame(a, b) {
  return a?.trial === b?.trial && a?.drive === b?.drive;
}

// What the charts have in common: a canvas of the size of its place, drawn at most once per animation frame. The points
// are drawn once, on a layer of their own; over it lies what follows the pointer. With the focus, arrow keys walk
// through the points, Enter keeps one, and Escape leaves.
class Chart {
  /** @type {any} */
  data = null;
  width = 0;
  height = 0;
  stale = false; // whether the layer has to be drawn again
  /** @type {number[] | null} */
  pressed = null; // where a drag began, and where it is
  /** @type {number[] | null} */
  dragged = null;
  /** @type {Pointed} */
  pointed = null;
  /** @type {number | null} */
  frame = null;
  draws = 0;

  /**
   * @param {string} id
   * @param {Events} events `height` is a part of the window's
   */
  constructor(id, { title, height, onpoint, onkeep, onclick = onkeep, ondrag = () => {}, drags = () => "" }) {
    this.part = height;
    this.onpoint = onpoint;
    this.onkeep = onkeep;
    this.onclick = onclick;
    this.ondrag = ondrag;
    this.drags = drags;
    this.canvas = element("canvas", { id, className: "vtb-chart", tabIndex: 0, role: "application" });
    this.canvas.setAttribute("aria-label", `${title}: arrow keys walk through the trials, Enter shows one`);
    this.layer = document.createElement("canvas");
    this.canvas.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => this.#move(event));
    this.canvas.addEventListener("pointerleave", () => onpoint(null));
    this.canvas.addEventListener("blur", () => onpoint(null));
    this.canvas.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => this.#press(event));
    this.canvas.addEventListener("pointerup", (/** @type {PointerEvent} */ event) => this.#release(event));
    this.canvas.addEventListener("pointercancel", () => (this.pressed = this.dragged = null));
    this.canvas.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => this.#key(event));
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
    addEventListener("vtb-theme", () => {
      this.stale = true;
      this.redraw();
    });
  }

  /** @returns {HTMLElement} what is shown or hidden */
  get element() {
    return this.canvas;
  }

  /**
   * @param {PointerEvent} event
   * @returns {number[]} its place in pixels
   */
  #place({ offsetX, offsetY }) {
    return [offsetX, offsetY];
  }

  /** @param {PointerEvent} event */
  #move(event) {
    const [px, py] = this.#place(event);
    if (this.pressed) {
      this.dragged = [px, py];
      if (this.drags()) this.redraw();
      return;
    }
    const pick = this.near(px, py);
    this.canvas.style.cursor = pick ? "pointer" : "crosshair";
    this.onpoint(pick);
  }

  /** @param {PointerEvent} event */
  #press(event) {
    // Without a drag to draw, a finger scrolls.
    if (event.pointerType !== "touch" || this.drags()) this.canvas.setPointerCapture(event.pointerId);
    this.pressed = this.#place(event);
    this.dragged = null;
  }

  /** @param {PointerEvent} event */
  #release(event) {
    const from = this.pressed;
    const to = this.#place(event);
    this.pressed = this.dragged = null;
    if (!from) return;
    if (Math.hypot(to[0] - from[0], to[1] - from[1]) < 5)
      this.onclick(this.near(to[0], to[1]), this.values(to[0], to[1]));
    else if (this.drags()) this.ondrag(this.values(from[0], from[1]), this.values(to[0], to[1]));
    this.redraw();
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const step = /** @type {Record<string, number>} */ (STEPS)[event.key];
    if (step) this.#walk(step);
    else if (event.key === "Enter") this.onkeep(this.pointed);
    else if (event.key === "Escape") this.onpoint(null);
    else return;
    event.preventDefault();
  }

  /** @param {number} step */
  #walk(step) {
    const picks = this.walked();
    if (!picks.length) return;
    const place = picks.findIndex((pick) => isSame(pick, this.pointed));
    const next = this.pointed ? place + step : step > 0 ? 0 : picks.length - 1;
    this.onpoint(picks[Math.min(Math.max(next, 0), picks.length - 1)]);
  }

  /** @returns {Pointed[]} what the keys walk through, in their order */
  walked() {
    const marked = (this.data?.marks ?? []).map((/** @type {Mark} */ { pick }) => pick).filter(Boolean);
    const trials = (this.data?.kind ?? []).map((/** @type {string} */ _, /** @type {number} */ k) => ({ trial: k }));
    return [...trials, ...marked];
  }

  /**
   * @abstract
   * @param {number} _px
   * @param {number} _py
   * @returns {Pointed} what is near a place in pixels
   */
  near(_px, _py) {
    return null;
  }

  /**
   * @abstract
   * @param {number} _px
   * @param {number} _py
   * @returns {number[]} the values at a place in pixels
   */
  values(_px, _py) {
    return [];
  }

  /**
   * @abstract
   * @param {CanvasRenderingContext2D} _pen draws the points
   */
  draw(_pen) {}

  /**
   * @abstract
   * @param {CanvasRenderingContext2D} _pen draws what follows the pointer
   */
  overlay(_pen) {}

  /**
   * Marks what the pointer is at.
   *
   * @param {Pointed} pick
   */
  point(pick) {
    this.pointed = pick;
    this.redraw();
  }

  redraw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      const ratio = devicePixelRatio,
        width = this.canvas.clientWidth;
      if (!width || !this.data) return;
      this.width = width;
      this.height = Math.max(120, Math.round(this.part * innerHeight));
      this.canvas.style.height = `${this.height}px`;
      this.canvas.style.touchAction = this.drags() ? "none" : "pan-y";
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
      this.canvas.dataset.draws = String(++this.draws);
    });
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {number} ratio pixels of the canvas per pixel of the style sheet
   * @returns {CanvasRenderingContext2D} what draws on it, when it is empty
   */
  #pen(canvas, ratio) {
    const pen = canvas.getContext("2d");
    if (!pen) throw new Error("the browser has no canvas");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.font = "11px system-ui, sans-serif";
    return pen;
  }
}

// Points over two axes. `data` is {x, y: arrays of values, color: index -> colour, kind: array, best,
// line: [[x, y], ...]}, with marks [{at: [x, y], tint, shape, pick}]: a mark with a pick can be pointed at as points
// are, whose pick is {trial}.
export class Scatter extends Chart {
  xScale = new Scale({ label: "", lower: 0, upper: 1 });
  yScale = new Scale({ label: "", lower: 0, upper: 1 });

  /**
   * @param {any} data
   * @param {Scale} xScale
   * @param {Scale} yScale
   */
  show(data, xScale, yScale) {
    this.data = data;
    this.xScale = xScale;
    this.yScale = yScale;
    this.stale = true;
    this.redraw();
  }

  /**
   * @param {number} value
   * @returns {number} its place in pixels
   */
  x(value) {
    return MARGIN.left + this.xScale.unit(value) * (this.width - MARGIN.left - MARGIN.right);
  }

  /**
   * @param {number} value
   * @returns {number} its place in pixels
   */
  y(value) {
    return this.height - MARGIN.bottom - this.yScale.unit(value) * (this.height - MARGIN.top - MARGIN.bottom);
  }

  /**
   * @override
   * @param {number} px
   * @param {number} py
   */
  values(px, py) {
    return [
      this.xScale.value((px - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right)),
      this.yScale.value((this.height - MARGIN.bottom - py) / (this.height - MARGIN.top - MARGIN.bottom)),
    ];
  }

  /** @override */
  walked() {
    const picks = super.walked();
    const x = this.data?.x ?? [];
    return picks.sort((a, b) => (x[a?.trial ?? -1] ?? Infinity) - (x[b?.trial ?? -1] ?? Infinity) || 0);
  }

  /**
   * @override
   * @param {number} px
   * @param {number} py
   * @returns {Pointed}
   */
  near(px, py) {
    if (!this.data) return null;
    /** @type {Pointed} */
    let nearest = null;
    let least = REACH;
    for (let k = 0; k < this.data.x.length; k++) {
      const distance = Math.hypot(this.x(this.data.x[k]) - px, this.y(this.#height(k)) - py);
      if (distance < least) [nearest, least] = [{ trial: k }, distance];
    }
    for (const { at, pick } of this.data.marks ?? []) {
      const distance = Math.hypot(this.x(at[0]) - px, this.y(at[1]) - py);
      if (pick && distance < least) [nearest, least] = [pick, distance];
    }
    return nearest;
  }

  /**
   * @param {number} k the number of a trial
   * @returns {number} its value; of one without a value the lower end
   */
  #height(k) {
    return this.data.y[k] ?? this.yScale.value(0.02);
  }

  /**
   * @override
   * @param {CanvasRenderingContext2D} pen
   */
  draw(pen) {
    const { grid, x, kind, line, best, marks = [], regions = [] } = this.data;
    if (grid?.mean) this.#cells(pen, grid);
    this.#axes(pen);
    pen.save();
    pen.beginPath();
    pen.rect(
      MARGIN.left - 10,
      MARGIN.top - 10,
      this.width - MARGIN.left - MARGIN.right + 20,
      this.height - MARGIN.top - MARGIN.bottom + 20,
    );
    pen.clip();
    for (const [x0, y0, x1, y1] of regions) this.#box(pen, this.x(x0), this.y(y0), this.x(x1), this.y(y1));
    if (line?.length) {
      pen.strokeStyle = palette.best;
      pen.lineWidth = 1.5;
      pen.beginPath();
      line.forEach((/** @type {[number, number]} */ [a, b], /** @type {number} */ k) =>
        pen[k ? "lineTo" : "moveTo"](this.x(a), this.y(b)),
      );
      pen.stroke();
    }
    const many = x.length > MANY,
      size = many ? 1.5 : 3.5;
    const style = many ? "dot" : grid?.mean ? "framed" : "";
    for (let k = 0; k < x.length; k++)
      point(pen, this.x(x[k]), this.y(this.#height(k)), size, kind[k], this.data.color(k), style);
    if (best >= 0) ring(pen, this.x(x[best]), this.y(this.#height(best)), 8, palette.best);
    for (const { at, tint, shape } of marks) mark(pen, this.x(at[0]), this.y(at[1]), tint, shape);
    pen.restore();
  }

  /**
   * @override
   * @param {CanvasRenderingContext2D} pen
   */
  overlay(pen) {
    const { x, marks = [] } = this.data,
      k = this.pointed?.trial ?? -1;
    const at = marks.find((/** @type {Mark} */ { pick }) => pick && isSame(pick, this.pointed))?.at;
    if (at) ring(pen, this.x(at[0]), this.y(at[1]), 10, palette.pointed);
    if (k >= 0 && k < x.length) ring(pen, this.x(x[k]), this.y(this.#height(k)), 7, palette.pointed);
    if (!this.pressed || !this.dragged) return;
    const shape = this.drags();
    if (shape === "box") this.#box(pen, this.pressed[0], this.pressed[1], this.dragged[0], this.dragged[1]);
    if (shape === "target") mark(pen, this.dragged[0], this.dragged[1], palette.aim, "target");
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {number} x0
   * @param {number} y0
   * @param {number} x1
   * @param {number} y1
   */
  #box(pen, x0, y0, x1, y1) {
    pen.fillStyle = "rgba(178, 24, 43, 0.18)";
    pen.strokeStyle = palette.bad;
    pen.lineWidth = 1;
    pen.fillRect(x0, y0, x1 - x0, y1 - y0);
    pen.strokeRect(x0, y0, x1 - x0, y1 - y0);
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {{x: number[], y: number[], mean: number[][]}} grid
   */
  #cells(pen, { x, y, mean }) {
    // Whole pixels: cells that overlap would show a net.
    const columns = edges(this.xScale, x).map((u) =>
      Math.round(MARGIN.left + u * (this.width - MARGIN.left - MARGIN.right)),
    );
    const rows = edges(this.yScale, y).map((u) =>
      Math.round(this.height - MARGIN.bottom - u * (this.height - MARGIN.top - MARGIN.bottom)),
    );
    mean.forEach((row, j) =>
      row.forEach((value, i) => {
        pen.fillStyle = this.data.shade(value);
        pen.fillRect(columns[i], rows[j + 1], columns[i + 1] - columns[i], rows[j] - rows[j + 1]);
      }),
    );
  }

  /** @param {CanvasRenderingContext2D} pen */
  #axes(pen) {
    const { left, right, top, bottom } = MARGIN,
      [width, height] = [this.width, this.height];
    pen.strokeStyle = palette.line;
    pen.fillStyle = palette.soft;
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
      pen.fillText(text.slice(0, 9), left - 6, this.y(value) + 4);
    }
    pen.fillStyle = palette.ink;
    pen.fillText(fitted(pen, this.xScale.label, width - left - right), width - right, height - 5);
    pen.textAlign = "left";
    pen.fillText(fitted(pen, this.yScale.label, width - 12), 6, 14);
  }
}

// One line per trial over all parameters and qualities, side by side. `data` is {columns: arrays, color, kind, order},
// with marks [{at: values, tint, pick}], which are broken lines and can be pointed at as in `Scatter`.
export class Parallel extends Chart {
  /** @type {Scale[]} */
  scales = [];

  /**
   * @param {any} data
   * @param {Scale[]} scales
   */
  show(data, scales) {
    this.data = data;
    this.scales = scales;
    this.stale = true;
    this.redraw();
  }

  /**
   * @param {number} axis
   * @returns {number} its place in pixels
   */
  x(axis) {
    return SIDE + (axis / Math.max(1, this.scales.length - 1)) * (this.width - 2 * SIDE);
  }

  /**
   * @param {number} axis
   * @param {number | null} value
   * @returns {number} its place in pixels; without a value, the lower end
   */
  y(axis, value) {
    const scale = this.scales[axis];
    return this.height - BELOW - scale.unit(value ?? scale.lower) * (this.height - BELOW - ABOVE);
  }

  /**
   * @override
   * @param {number} px
   * @param {number} py
   * @returns {Pointed}
   */
  near(px, py) {
    if (!this.data) return null;
    const axes = this.scales.length - 1,
      place = ((px - SIDE) / (this.width - 2 * SIDE)) * axes;
    const left = Math.min(Math.max(Math.floor(place), 0), axes - 1),
      share = place - left;
    /** @type {Pointed} */
    let nearest = null;
    let least = REACH;
    const { columns, kind, marks = [] } = this.data;
    const measure = (/** @type {Pointed} */ pick, /** @type {number} */ from, /** @type {number} */ to) => {
      const [a, b] = [this.y(left, from), this.y(left + 1, to)];
      const distance = Math.abs(a + share * (b - a) - py);
      if (distance < least) [nearest, least] = [pick, distance];
    };
    for (let k = 0; k < kind.length; k++) measure({ trial: k }, columns[left][k], columns[left + 1][k]);
    for (const { at, pick } of marks) measure(pick, at[left], at[left + 1]);
    return nearest;
  }

  /** @returns {number[] | null | undefined} the values of what the pointer is at */
  #pointedValues() {
    const { kind, marks = [] } = this.data;
    const trial = this.pointed?.trial;
    if (trial === undefined) return marks.find((/** @type {Mark} */ { pick }) => isSame(pick, this.pointed))?.at;
    return trial < kind.length ? this.#column(trial) : null;
  }

  /**
   * @param {number} k the number of a trial
   * @returns {number[]} its values
   */
  #column(k) {
    return this.data.columns.map((/** @type {number[]} */ column) => column[k]);
  }

  /**
   * @override
   * @param {CanvasRenderingContext2D} pen
   */
  draw(pen) {
    const { color: tint, order, best, marks = [] } = this.data;
    pen.globalAlpha = Math.min(1, Math.max(0.06, 150 / order.length));
    pen.lineWidth = 1;
    for (const k of order) this.#line(pen, this.#column(k), tint(k));
    pen.globalAlpha = 1;
    pen.lineWidth = 2.5;
    if (best >= 0) this.#line(pen, this.#column(best), palette.best);
    pen.lineWidth = 1.5;
    pen.setLineDash([6, 4]);
    for (const drawn of marks) this.#line(pen, drawn.at, drawn.tint);
    pen.setLineDash([]);
    this.scales.forEach((scale, axis) => this.#axis(pen, scale, axis));
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Scale} scale
   * @param {number} axis
   */
  #axis(pen, scale, axis) {
    const last = this.scales.length - 1;
    const at = this.x(axis);
    pen.fillStyle = palette.soft;
    pen.fillRect(at, ABOVE, 1, this.height - BELOW - ABOVE);
    pen.textAlign = axis === 0 ? "left" : axis === last ? "right" : "center";
    const shift = axis === 0 ? 4 - SIDE : axis === last ? SIDE - 4 : 0;
    const [lower, upper] = scale.ends();
    pen.fillText(upper, at + shift, 16);
    pen.fillText(lower, at + shift, this.height - BELOW + 12);
    pen.fillStyle = palette.ink;
    // In two rows, so that each has the room of two.
    const spacing = (this.width - 2 * SIDE) / last;
    const room = axis % last ? 1.8 * spacing : spacing + SIDE;
    pen.fillText(fitted(pen, scale.label, room - 8), at + shift, this.height - (axis % 2 ? 4 : 18));
  }

  /**
   * @override
   * @param {CanvasRenderingContext2D} pen
   */
  overlay(pen) {
    pen.lineWidth = 2.5;
    const values = this.#pointedValues();
    if (values) this.#line(pen, values, palette.pointed);
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {(number | null)[]} values
   * @param {string} tint
   */
  #line(pen, values, tint) {
    pen.strokeStyle = tint;
    pen.beginPath();
    values.forEach((value, axis) => pen[axis ? "lineTo" : "moveTo"](this.x(axis), this.y(axis, value)));
    pen.stroke();
  }
}

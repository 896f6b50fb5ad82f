// The scale of an axis, and labels that fit.

import { number } from "./common.js";

/** The scale of an axis; options of a choice stand side by side. */
export class Scale {
  lower = 0;
  upper = 1;

  /**
   * @param {{
   *   label: string, lower: number, upper: number, log?: boolean, integer?: boolean, options?: any[] | null
   * }} axis its label and its range, or the options of a choice instead
   */
  constructor({ label, lower, upper, log = false, integer = false, options = null }) {
    this.label = label;
    this.log = log;
    this.integer = integer;
    this.options = options;
    [this.lower, this.upper] = options ? [-0.5, options.length - 0.5] : [lower, upper];
    if (!(this.lower < this.upper)) [this.lower, this.upper] = [this.lower - 0.5, this.upper + 0.5];
  }

  /**
   * @param {number} value
   * @returns {number} its place on the axis, from 0 to 1
   */
  unit(value) {
    if (this.log) return Math.log(value / this.lower) / Math.log(this.upper / this.lower);
    return (value - this.lower) / (this.upper - this.lower);
  }

  /**
   * @param {number} unit a place on the axis, from 0 to 1
   * @returns {number} the value there; of a choice the number of the nearest option
   */
  value(unit) {
    if (this.options)
      return Math.min(Math.max(Math.round(this.lower + unit * (this.upper - this.lower)), 0), this.options.length - 1);
    unit = Math.min(Math.max(unit, 0), 1);
    if (this.log) return this.lower * (this.upper / this.lower) ** unit;
    return this.lower + unit * (this.upper - this.lower);
  }

  /**
   * @param {number} count at most about so many, unless they are options
   * @returns {[number, string][]} values with their texts
   */
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
    const rough = (this.upper - this.lower) / count,
      power = 10 ** Math.floor(Math.log10(rough));
    const round = [1, 2, 5].map((m) => m * power).find((s) => s >= rough) ?? 10 * power;
    const step = this.integer ? Math.max(1, round) : round;
    /** @type {[number, string][]} */
    const ticks = [];
    for (let k = Math.ceil(this.lower / step - 1e-9); k * step <= this.upper + 1e-9 * step; k++)
      ticks.push([k * step, number(k * step)]);
    return ticks;
  }

  /** @returns {[string, string]} the texts of the ends */
  ends() {
    if (this.options) return [String(this.options[0]), String(this.options.at(-1))];
    return [number(this.lower), number(this.upper)];
  }
}

/**
 * @param {Scale} scale
 * @param {number[]} centres of cells, in the order of the axis
 * @returns {number[]} the edges of the cells, from 0 to 1
 */
export function edges(scale, centres) {
  const units = centres.map((value) => scale.unit(value));
  const middles = units.slice(1).map((u, k) => (u + units[k]) / 2);
  return [0, ...middles, 1];
}

/**
 * @param {CanvasRenderingContext2D} pen
 * @param {string} text a label, whose end is what tells it from others
 * @param {number} width in pixels
 * @returns {string} as much of its end as fits
 */
export function fitted(pen, text, width) {
  if (pen.measureText(text).width <= width) return text;
  let shown = text;
  while (shown.length > 4 && pen.measureText(`…${shown}`).width > width) shown = shown.slice(1);
  return `…${shown}`;
}

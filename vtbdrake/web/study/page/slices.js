// Every parameter by itself: a quality over each, coloured by the order of the trials.

import { Scatter } from "./charts.js";
import { element } from "./common.js";
import { shade } from "./palette.js";

/**
 * @typedef {import("./charts.js").Events} Events
 * @typedef {import("./charts.js").Pointed} Pointed
 * @typedef {import("./scale.js").Scale} Scale
 */

export class Slices {
  /**
   * @param {string[]} labels of the parameters
   * @param {Events} events
   */
  constructor(labels, events) {
    this.charts = labels.map((label, k) => new Scatter(`vtb-slice-${k}`, { ...events, title: `values over ${label}` }));
    this.element = element("div", { id: "vtb-slices" }, ...this.charts.map(({ canvas }) => canvas));
  }

  /** @param {Pointed} pick what the pointer is at */
  point(pick) {
    for (const chart of this.charts) chart.point(pick);
  }

  /**
   * @param {any} common kinds, best and marks of the trials
   * @param {{points: number[][], values: (number | null)[]}} columns of the trials: parameters, and one quality
   * @param {Scale[]} scales of the parameters
   * @param {Scale} valueScale
   */
  show(common, { points, values }, scales, valueScale) {
    const last = Math.max(1, values.length - 1);
    const color = (/** @type {number} */ k) => shade(k / last);
    this.charts.forEach((chart, k) =>
      chart.show({ ...common, x: points[k] ?? [], y: values, color, marks: [] }, scales[k], valueScale),
    );
  }
}

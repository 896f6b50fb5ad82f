// The course of a variable over simulated time, by uPlot: with unit, legend, cursor, zoom and export.

import { button, element, number } from "./common.js";
import { color } from "./theme.js";

const WINDOW = 20; // s of simulated time that are shown while nothing is zoomed
const KEPT = 20_000; // samples that are kept
const SERIES = 6; // colours
const HEIGHT = 150; // px, without the legend
const MARGIN = 12; // px, around a plot that is exported

/**
 * @param {string} href
 * @param {string} name of the file
 */
function download(href, name) {
  element("a", { href, download: name }).click();
}

export class Plot {
  zoomed = false;
  /** @type {any} */
  plot = null;
  /** @type {number | null} */
  coming = null; // the animation frame that draws

  /**
   * @param {string} name of what is plotted
   * @param {string[]} units of the series, empty for numbers without one
   * @param {string[]} labels of the series
   */
  constructor(name, units, labels) {
    this.name = name;
    this.units = units;
    this.unit = [...new Set(units)].filter(Boolean).join(", ");
    this.labels = labels;
    /** @type {(number | null)[][]} */
    this.data = [[], ...labels.map(() => [])];
    this.place = element("div");
    this.whole = button("", "follow", "show the last seconds again (double click)", () => this.#follow());
    this.whole.hidden = true;
    this.root = element(
      "div",
      { className: "vtb-plot" },
      this.place,
      element(
        "p",
        { className: "vtb-buttons" },
        button("", "CSV", `save the values of ${name} as a table`, () => this.#saveTable()),
        button("", "PNG", `save the plot of ${name} as a picture`, () => this.#savePicture()),
        this.whole,
      ),
    );
    this.observer = new ResizeObserver(() => this.#fit());
    this.recolor = () => this.plot?.redraw();
  }

  // Draws the axes, in a place that is part of the page now.
  begin() {
    this.plot = new uPlot(
      {
        width: this.#width,
        height: HEIGHT,
        legend: { live: true, markers: { width: 2 } },
        cursor: { drag: { x: true, y: false, setScale: true }, points: { size: 6 } },
        scales: { x: { time: false }, y: { range: padded } },
        axes: [this.#axis("s", { size: 22, space: 50 }), this.#axis(this.unit, { size: 48 })],
        series: [
          { label: "t", value: (/** @type {any} */ _, /** @type {number | null} */ t) => shown(t, "s") },
          ...this.labels.map((label, index) => ({
            label,
            stroke: () => color(`--series-${(index % SERIES) + 1}`),
            dash: index < SERIES ? undefined : [6, 3],
            width: 1.5,
            value: (/** @type {any} */ _, /** @type {number | null} */ value) => shown(value, ""),
          })),
        ],
        hooks: { setSelect: [(/** @type {any} */ plot) => plot.select.width > 0 && this.#zoom(true)] },
      },
      this.data,
      this.place,
    );
    this.plot.over.addEventListener("dblclick", () => this.#follow());
    this.observer.observe(this.root);
    addEventListener("vtb-theme", this.recolor);
  }

  /**
   * @param {string} label
   * @param {{ size: number, space?: number }} sizes
   * @returns {object} an axis of uPlot
   */
  #axis(label, sizes) {
    const grid = { stroke: () => color("--line"), width: 1 };
    const font = "11px system-ui, sans-serif";
    const text = { font, label, labelSize: label ? 14 : 0, labelFont: font, labelGap: 0 };
    return { ...sizes, ...text, stroke: () => color("--soft"), grid, ticks: { ...grid, size: 4 } };
  }

  get #width() {
    return Math.max(this.root.clientWidth, 120);
  }

  #fit() {
    if (this.plot && this.plot.width !== this.#width) this.plot.setSize({ width: this.#width, height: HEIGHT });
  }

  /** @param {boolean} zoomed */
  #zoom(zoomed) {
    this.zoomed = zoomed;
    this.whole.hidden = !zoomed;
  }

  #follow() {
    this.#zoom(false);
    this.#draw();
  }

  /**
   * Adds the values at a time; those of later times, to which the session has gone back, are dropped.
   *
   * @param {number} time
   * @param {(number | null)[]} values
   */
  extend(time, values) {
    const [times] = this.data;
    while (times.length && Number(times.at(-1)) >= time) for (const series of this.data) series.pop();
    times.push(time);
    for (const index of this.labels.keys()) this.data[index + 1].push(values[index] ?? null);
    while (times.length > KEPT) for (const series of this.data) series.shift();
    this.#draw();
  }

  // Once for each picture of the page.
  #draw() {
    this.coming ??= requestAnimationFrame(() => {
      this.coming = null;
      this.#drawNow();
    });
  }

  #drawNow() {
    if (!this.plot) return;
    const [times] = this.data;
    this.plot.setData(this.data, false);
    const { min, max } = this.plot.scales.x;
    const last = Number(times.at(-1) ?? 0);
    const first = Math.max(Number(times[0] ?? 0), last - WINDOW);
    this.plot.setScale("x", this.zoomed ? { min, max } : { min: first, max: Math.max(last, first + 1) });
    if (this.plot.cursor.left < 0) this.plot.setLegend({ idx: times.length - 1 }); // The last values, without a cursor.
  }

  destroy() {
    this.observer.disconnect();
    removeEventListener("vtb-theme", this.recolor);
    this.plot?.destroy();
    this.plot = null;
    this.root.remove();
  }

  // -- export

  /** @returns {string} the values as a table with a head */
  table() {
    const unit = (/** @type {number} */ index) => (this.units[index] ? ` [${this.units[index]}]` : "");
    const quoted = (/** @type {string} */ text) => `"${text.replaceAll('"', '""')}"`;
    const head = ["t [s]", ...this.labels.map((label, index) => `${label}${unit(index)}`)].map(quoted).join(",");
    const rows = this.data[0].map((_, row) => this.data.map((series) => series[row] ?? "").join(","));
    return [head, ...rows].join("\n") + "\n";
  }

  #saveTable() {
    const url = URL.createObjectURL(new Blob([this.table()], { type: "text/csv" }));
    download(url, `${this.name}.csv`);
    URL.revokeObjectURL(url);
  }

  // The canvas of uPlot has neither a background nor the legend.
  #savePicture() {
    const drawn = this.plot.ctx.canvas;
    const ratio = devicePixelRatio;
    const line = 16 * ratio;
    const margin = MARGIN * ratio;
    const legend = this.labels.length > 1 ? this.labels : [];
    const picture = element("canvas", {
      width: drawn.width + 2 * margin,
      height: drawn.height + 2 * margin + line * (1 + legend.length),
    });
    const context = picture.getContext("2d");
    context.fillStyle = color("--card");
    context.fillRect(0, 0, picture.width, picture.height);
    context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.fillStyle = color("--ink");
    context.fillText(this.unit ? `${this.name} (${this.unit})` : this.name, margin, margin + 0.7 * line);
    context.drawImage(drawn, margin, margin + line);
    for (const [index, label] of legend.entries()) {
      context.fillStyle = color(`--series-${(index % SERIES) + 1}`);
      context.fillText(`— ${label}`, margin, margin + drawn.height + line * (index + 1.8));
    }
    download(picture.toDataURL("image/png"), `${this.name}.png`);
  }
}

/**
 * @param {number | null} value
 * @param {string} unit
 * @returns {string} the value as the legend shows it
 */
function shown(value, unit) {
  if (value === null || value === undefined) return "–";
  return unit ? `${number(value)} ${unit}` : number(value);
}

/**
 * @param {any} _plot
 * @param {number | null} least
 * @param {number | null} most
 * @returns {[number, number]} the range of an axis with some air around the values
 */
function padded(_plot, least, most) {
  if (least === null || most === null) return [-1, 1];
  const air = least < most ? 0.06 * (most - least) : Math.max(Math.abs(least), 1);
  return [least - air, most + air];
}

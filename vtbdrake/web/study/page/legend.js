// What colours and symbols of the charts mean: a bar of colours with values, and a symbol beside each of its texts.

import { element, number } from "./common.js";
import { GRADIENT, palette, shade } from "./palette.js";
import { mark, point, ring } from "./symbols.js";

const SIZE = 18; // px, of a symbol's picture
const TICKS = 5; // places on the bar that have a value
const LINE = 8; // px, half the length of a line's sample

/**
 * How each symbol is drawn, in the middle of its picture.
 *
 * @type {Record<string, (pen: CanvasRenderingContext2D, at: number) => void>}
 */
const SYMBOLS = {
  feasible: (pen, at) => point(pen, at, at, 4, "feasible", shade(0.6)),
  broken: (pen, at) => point(pen, at, at, 4, "broken", ""),
  dropped: (pen, at) => point(pen, at, at, 4, "dropped", ""),
  failed: (pen, at) => point(pen, at, at, 4, "failed", ""),
  best: (pen, at) => ring(pen, at, at, 6, palette.best),
  line: (pen, at) => {
    pen.strokeStyle = palette.best;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(at - LINE, at);
    pen.lineTo(at + LINE, at);
    pen.stroke();
  },
  front: (pen, at) => point(pen, at, at, 4, "feasible", palette.best),
  behind: (pen, at) => point(pen, at, at, 4, "feasible", palette.dropped),
  driven: (pen, at) => mark(pen, at, at, palette.driven, "diamond"),
  tried: (pen, at) => mark(pen, at, at, palette.tried, "box"),
  draft: (pen, at) => mark(pen, at, at, palette.ink, "cross"),
  aim: (pen, at) => mark(pen, at, at, palette.aim, "target"),
};

/** The symbols that the charts have at present, with their texts. */
export class Legend {
  /** @type {[string, string][]} */
  #items = [];

  constructor() {
    this.list = element("ul", { id: "vtb-legend", ariaLabel: "symbols" });
    addEventListener("vtb-theme", () => this.#draw());
  }

  /** @param {[string, string][]} items symbols with their texts */
  show(items) {
    if (JSON.stringify(items) === JSON.stringify(this.#items)) return;
    this.#items = items;
    this.#draw();
  }

  #draw() {
    this.list.replaceChildren(...this.#items.map(([symbol, text]) => element("li", {}, picture(symbol), text)));
  }
}

/**
 * @param {string} symbol
 * @returns {HTMLCanvasElement} its picture
 */
function picture(symbol) {
  const canvas = element("canvas", { width: SIZE * devicePixelRatio, height: SIZE * devicePixelRatio });
  canvas.setAttribute("aria-hidden", "true");
  const pen = canvas.getContext("2d");
  pen.scale(devicePixelRatio, devicePixelRatio);
  SYMBOLS[symbol](pen, SIZE / 2);
  return canvas;
}

/** A bar of the colours of values. */
export class ColorBar {
  constructor() {
    this.title = element("span", { className: "vtb-bar-title" });
    this.ticks = element("span", { className: "vtb-bar-ticks" });
    const colors = element("span", { className: "vtb-bar-colors", style: `background: ${GRADIENT}` });
    this.bar = element("div", { id: "vtb-colors" }, this.title, colors, this.ticks);
  }

  get element() {
    return this.bar;
  }

  /**
   * @param {string} title what the colours tell
   * @param {number[]} sorted what is coloured in the order of the bar, from the worst: equal shares have equal colours
   */
  show(title, sorted) {
    const count = Math.min(TICKS, sorted.length);
    const places = [...Array(count).keys()].map((k) => Math.round((k / Math.max(1, count - 1)) * (sorted.length - 1)));
    this.bar.hidden = count < 2;
    this.title.textContent = title;
    this.ticks.replaceChildren(...places.map((place) => element("span", {}, number(sorted[place], 3))));
  }
}

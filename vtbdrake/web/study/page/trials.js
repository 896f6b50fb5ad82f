// What a page has of a study: its trials as columns, which of them are the best, and the rollouts driven by hand.

import { palette } from "./palette.js";

export class Trials {
  /** @type {number[][]} by parameter, then by trial; of a choice the number of the option */
  points = [];
  /** @type {(number | null)[][]} by quality, then by trial */
  values = [];
  /** @type {string[]} */
  kinds = [];
  /** @type {string[]} */
  methods = [];
  /** @type {number[]} */
  batches = [];
  /** @type {Set<number>} */
  byHand = new Set();
  /** @type {Record<number, string>} */
  reasons = {};
  /** @type {number[]} */
  front = []; // the Pareto front along the first quality; empty for one quality
  /** @type {Set<number>} */
  excluded = new Set(); // trials in forbidden regions
  best = -1;
  /** @type {[number, number][]} */
  bestLine = []; // the best value so far: [trial, value]

  /** @param {number[]} sign 1 for each quality that is maximized, and -1 for the others */
  constructor(sign) {
    this.sign = sign;
  }

  get count() {
    return this.kinds.length;
  }

  /**
   * Takes new trials behind the first ones; the others were recorded again.
   *
   * @param {any} message of the server
   */
  take({ first, points, values, kinds, methods, batches, by_hand, reasons, front, excluded }) {
    /** @type {(mine: any[], news: any[]) => void} */
    const extend = (mine, news) => {
      mine.length = Math.min(mine.length, first);
      for (const value of news) mine.push(value);
    };
    points.forEach((/** @type {number[]} */ column, /** @type {number} */ k) =>
      extend((this.points[k] ??= []), column),
    );
    const columns = values.length ? values : this.values.map(() => []);
    columns.forEach((/** @type {(number | null)[]} */ column, /** @type {number} */ k) =>
      extend((this.values[k] ??= []), column),
    );
    extend(this.kinds, kinds);
    extend(this.methods, methods);
    extend(this.batches, batches);
    for (const k of [...this.byHand]) if (k >= first) this.byHand.delete(k);
    for (const k of by_hand) this.byHand.add(first + k);
    for (const k of Object.keys(this.reasons).map(Number)) if (k >= first) delete this.reasons[k];
    for (const [k, reason] of Object.entries(reasons)) this.reasons[first + Number(k)] = String(reason);
    this.front = front;
    this.excluded = new Set(excluded);
    this.#rank();
  }

  /**
   * @param {number} k a trial
   * @returns {number[]} its point
   */
  point(k) {
    return this.points.map((column) => column[k]);
  }

  #rank() {
    this.best = -1;
    this.bestLine = [];
    if (this.sign.length > 1) {
      // The one of the front that is the best in the first quality.
      if (this.front.length) this.best = this.front[this.sign[0] > 0 ? this.front.length - 1 : 0];
      return;
    }
    const values = /** @type {number[]} */ (this.values[0]), // of feasible trials, all are numbers
      [sign] = this.sign;
    for (const [k, kind] of this.kinds.entries()) {
      if (kind !== "feasible" || this.excluded.has(k)) continue;
      if (this.best >= 0 && sign * values[k] <= sign * values[this.best]) continue;
      if (this.best >= 0) this.bestLine.push([k, values[this.best]]);
      this.bestLine.push([k, values[k]]);
      this.best = k;
    }
    if (this.best >= 0) this.bestLine.push([this.count - 1, values[this.best]]);
  }

  /**
   * @param {number} quality
   * @returns {number[]} its values that have a shade, the smallest first
   */
  sorted(quality) {
    const column = this.values[quality] ?? [];
    const shaded = column.filter((value, k) => value !== null && this.kinds[k] !== "dropped");
    return /** @type {number[]} */ (shaded).sort((a, b) => a - b);
  }

  /**
   * @param {number} quality
   * @returns {(value: number | null) => number} the shade of a value, by its rank, so that outliers leave colours for
   *   the rest
   */
  shades(quality) {
    const sorted = this.sorted(quality);
    return (value) => {
      if (value === null || !sorted.length) return NaN;
      let [low, high] = [0, sorted.length];
      while (low < high) {
        const middle = (low + high) >> 1;
        if (sorted[middle] < value) low = middle + 1;
        else high = middle;
      }
      const rank = sorted.length > 1 ? low / (sorted.length - 1) : 1;
      return this.sign[quality] > 0 ? rank : 1 - rank;
    };
  }
}

/**
 * @typedef {{
 *   number: number, name: string, point: (number | null)[], values: (number | null)[], kind: string, message: string,
 *   after: number
 * }} Drive
 */

// Rollouts that somebody has driven by hand.
export class Drives {
  /** @type {Drive[]} */
  drives = [];

  /**
   * Takes what is driven now.
   *
   * @param {any} driven the columns of the drives
   * @returns {boolean} whether there is something new
   */
  take({ numbers, names, points, values, kinds, messages, after }) {
    const isSame = this.drives.length === numbers.length && this.drives.at(-1)?.number === numbers.at(-1);
    this.drives = numbers.map((/** @type {number} */ number, /** @type {number} */ k) => {
      const [name, point, kind, message] = [names[k], points[k], kinds[k], messages[k]];
      return { number, name, point, values: values[k], kind, message, after: after[k] };
    });
    return !isSame;
  }

  /** @param {number | undefined} number */
  numbered(number) {
    return this.drives.find((drive) => drive.number === number);
  }

  /**
   * @param {(drive: Drive) => (number | null)[]} place
   * @returns {any[]} a mark for each at its place; one without a place has none
   */
  marks(place) {
    const marks = this.drives.map((drive) => ({
      at: place(drive),
      tint: drive.kind === "feasible" ? palette.driven : palette.bad,
      shape: "diamond",
      pick: { drive: drive.number },
    }));
    return marks.filter(({ at }) => at.every((value) => value !== null));
  }
}
